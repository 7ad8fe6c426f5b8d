"""``ghgs import`` and ``ghgs export``: convert published weights to a checkpoint and back."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from torch import Tensor

from ghgs_lit.cli.inputs import MODEL_NODES
from ghgs_lit.cli.runtime import announce, files_to_write, output_dir, write_config
from ghgs_lit.errors import require
from ghgs_lit.method.model import GHGS
from ghgs_lit.weights.checkpoint import read_config, write_inference
from ghgs_lit.weights.published import export_weights, import_weights
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
    """Write the requested files, and print how the model differs from the release.

    Raises:
        InputError: No file is requested, a file exists, or the checkpoint is wrong.
    """
    write_config(verb, output_dir())
    checkpoint = verb.checkpoint
    keys = ("vggt", "release", "inference")
    paths = files_to_write(verb, keys, [file_of(checkpoint)])
    vggt, release, inference = map(paths.get, keys)
    require(bool(paths), "vggt", "vggt=<file>, release=<file> or inference=<file>", None)
    if vggt is not None or release is not None:
        print("\n".join(export_weights(checkpoint, vggt, release)), flush=True)
        differing = differences(read_config(checkpoint))
        if release is not None and differing:
            print(f"differs from the release: {', '.join(differing)}", flush=True)
    if inference is not None:
        write_inference(checkpoint, inference, verb.dtype)
        sizes = (file_of(path).stat().st_size / 1e6 for path in (checkpoint, inference))
        print("{:.1f} MB to {:.1f} MB".format(*sizes), flush=True)
    announce(paths.popitem()[1])
