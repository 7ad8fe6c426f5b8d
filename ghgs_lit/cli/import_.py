"""``ghgs import``: convert published weights to a checkpoint of this package."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from omegaconf import DictConfig
from torch import Tensor

from ghgs_lit.cli.inputs import MODEL_NODES
from ghgs_lit.cli.runtime import announce, files_to_write, output_dir, save_config
from ghgs_lit.model import GHGS
from ghgs_lit.weights.importing import import_weights
from ghgs_lit.weights.switches import differences

if TYPE_CHECKING:
    from ghgs_lit.cli.verbs import Import


def empty_state(config: Mapping[str, Any], release: str | None) -> dict[str, Tensor]:
    """Tensors that published weights fill, on the meta device.

    Args:
        config: the nodes of the model as plain data.
        release: the authors' checkpoint; None: the tensors of the encoder alone.
    """
    state = GHGS.from_config(config, empty=True).state_dict()
    return {name: tensor for name, tensor in state.items() if release or name.startswith("encoder.")}


def run(options: "Import", cfg: DictConfig) -> None:
    """Write the checkpoint, and print what it was made of.

    Args:
        options: keys of the verb.
        cfg: the whole configuration that Hydra composed.

    Raises:
        InputError: the weights do not fit the model, or the file exists.
    """
    config = save_config(cfg, output_dir())
    model = {key: config[key] for key in MODEL_NODES if key in config}
    sources = (options.vggt, options.release)
    out = files_to_write(options, ["out"], [path for path in sources if path is not None])["out"]
    report = import_weights(empty_state(model, options.release), model, out, *sources, options.dtype)
    print("\n".join(report), flush=True)
    if options.release is not None and (differing := differences(config)):
        print(f"differs from the release: {', '.join(differing)}", flush=True)
    announce(out)
