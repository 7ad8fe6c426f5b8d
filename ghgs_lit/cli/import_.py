"""``ghgs import``: convert published weights to a checkpoint of this package."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from torch import Tensor

from ghgs_lit.cli.inputs import MODEL_NODES
from ghgs_lit.cli.runtime import announce, files_to_write, output_dir, write_config
from ghgs_lit.method.model import GHGS
from ghgs_lit.weights.published import import_weights
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


def run(verb: "Import") -> None:
    """Write the checkpoint, and print what it was made of.

    Args:
        verb: the run.

    Raises:
        InputError: the weights do not fit the model, or the file exists.
    """
    write_config(verb, output_dir())
    config = verb.plain
    model = {key: config[key] for key in MODEL_NODES if key in config}
    sources = (verb.vggt, verb.release)
    out = files_to_write(verb, ["out"], [path for path in sources if path is not None])["out"]
    report = import_weights(empty_state(model, verb.release), model, out, *sources, verb.dtype)
    print("\n".join(report), flush=True)
    if verb.release is not None and (differing := differences(config)):
        print(f"differs from the release: {', '.join(differing)}", flush=True)
    announce(out)
