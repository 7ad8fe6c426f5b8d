"""``ghgs import`` and ``ghgs export``: published weights to a checkpoint, and a checkpoint to a small one."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from torch import Tensor

from ghgs_lit.cli.inputs import MODEL_NODES
from ghgs_lit.cli.runtime import announce, files_to_write, output_dir, write_config
from ghgs_lit.method.model import GHGS
from ghgs_lit.weights.checkpoint import write_inference
from ghgs_lit.weights.published import import_weights
from ghgs_lit.weights.reading import file_of
from ghgs_lit.weights.switches import differences

if TYPE_CHECKING:
    from ghgs_lit.cli.verbs import Export, Import


def empty_state(config: Mapping[str, Any], release: str | None) -> dict[str, Tensor]:
    """Tensors to fill with published weights, on the meta device.

    Args:
        config: Model nodes as plain data.
        release: The authors' checkpoint; None: only the tensors of the encoder.
    """
    state = GHGS.from_config(config, empty=True).state_dict()
    return {name: tensor for name, tensor in state.items() if release or name.startswith("encoder.")}


def run_import(verb: "Import") -> None:
    """Write the checkpoint, and print a report of its origin.

    Raises:
        InputError: The weights do not fit the model, or the file exists.
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


def run_export(verb: "Export") -> None:
    """Write the checkpoint for prediction, and print both sizes.

    Raises:
        InputError: The file exists, or the checkpoint is wrong.
    """
    write_config(verb, output_dir())
    path = files_to_write(verb, ["inference"], [file_of(verb.checkpoint)])["inference"]
    write_inference(verb.checkpoint, path, verb.dtype)
    sizes = (file_of(each).stat().st_size / 1e6 for each in (verb.checkpoint, path))
    print("{:.1f} MB to {:.1f} MB".format(*sizes), flush=True)
    announce(path)
