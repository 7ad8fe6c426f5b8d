"""Export of checkpoints: tensors under their published names,
or a small checkpoint for prediction."""

from pathlib import Path

import torch
from safetensors.torch import save_file
from torch import Tensor

from ghgs_lit.errors import InputError, require
from ghgs_lit.files import resolved, write_atomically
from ghgs_lit.weights import names
from ghgs_lit.weights.checkpoint import model_state, read_checkpoint, require_finite, write_checkpoint
from ghgs_lit.weights.reading import cast
from ghgs_lit.weights.switches import differences


def export_weights(checkpoint: str | Path, vggt: str | Path | None, release: str | Path | None) -> list[str]:
    """Write the tensors of a checkpoint, bit for bit, under their published names.

    Args:
        checkpoint: of this package.
        vggt: file for the encoder (safetensors or PyTorch, by its suffix); None: not written.
        release: PyTorch file for all other stages; None: not written.

    Returns:
        A report, a line for each file.

    Raises:
        InputError: both are None, or a tensor has no published name; then nothing is written.
    """
    require(vggt is not None or release is not None, "vggt", "vggt=<file>, release=<file> or both", None)
    content = read_checkpoint(checkpoint, whole=True)
    state = model_state(content)
    encoder = {name: tensor for name, tensor in state.items() if name.startswith("encoder.")}
    heads = {name: tensor for name, tensor in state.items() if name not in encoder}
    files = []
    for path, part, table, entry in (
        (vggt, encoder, names.VGGT, None),
        (release, heads, names.RELEASE, names.RELEASE_ENTRY),
    ):
        if path is not None:
            require(bool(part), str(checkpoint), f"tensors for {path}", "the encoder alone")
            named = {names.to_published(name, table): name for name in part}
            if None in named:
                differing = ", ".join(differences(content["config"]))
                raise InputError(
                    f"{checkpoint}: expected a model of the release's form for release=<file>; found one"
                    f" without a published form, with {named[None]} (it differs in {differing})"
                )
            files.append((path, {published: part[name] for published, name in named.items()}, entry))
    for file in files:
        write_tensors(*file)
    return [f"{path}: {len(tensors)} tensors" for path, tensors, _ in files]


def write_tensors(path: str | Path, tensors: dict[str, Tensor], entry: str | None = None) -> None:
    """Write tensors as safetensors or a PyTorch file, by the suffix of the path.

    Args:
        path: of the file.
        tensors: by name.
        entry: key of the PyTorch file that holds them, if any.

    Raises:
        InputError: ``entry`` is given for safetensors, which are not nested.
    """
    if Path(path).suffix == ".safetensors":
        require(entry is None, "release", f"a PyTorch file (.pth), which holds {entry!r}", ".safetensors")
        write_atomically(path, lambda temporary: save_file(tensors, temporary, metadata={"format": "pt"}))
    else:
        content = tensors if entry is None else {entry: tensors}
        write_atomically(path, lambda temporary: torch.save(content, temporary))


def write_inference(checkpoint: str | Path, path: str | Path, dtype: str) -> None:
    """Write the model of a checkpoint without optimizer, losses and progress.

    Args:
        checkpoint: of a whole model.
        path: of the file to write.
        dtype: of all weights: ``float16``, ``bfloat16`` or ``float32``.

    Raises:
        InputError: a weight overflows the dtype, both are one file, or the checkpoint holds the
            encoder alone.
    """
    if resolved(checkpoint) == resolved(path):
        raise InputError(f"inference={path}: expected another file than the checkpoint; found the same")
    content = read_checkpoint(checkpoint, whole=True)
    require("depth_head" in content["config"], str(checkpoint), "a whole model", "the encoder alone")
    state = cast(lambda: model_state(read_checkpoint(checkpoint)), lambda *_: getattr(torch, dtype))
    require_finite(state, f"{checkpoint} as {dtype}")
    # Paths of the machine that trained it are dropped; loading reads ``imported``.
    config = {**content["config"], "resume": None, "init_from": None}
    facts = {"imported": content["imported"]} if "imported" in content else {}
    write_checkpoint(path, state, config, **facts)
