"""A checkpoint of this package back to the published names: for the authors' code, or VGGT's."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import save_file
from torch import Tensor

from ghgs_lit.errors import InputError, require
from ghgs_lit.weights import names
from ghgs_lit.weights.checkpoint import model_state, read_checkpoint, write_aside


def export_weights(checkpoint: str | Path, vggt: str | Path | None, release: str | Path | None) -> list[str]:
    """Write the encoder to ``vggt`` and all else to ``release``; where one is None it is left out.

    Files are safetensors or PyTorch's, by their ending; the tensors are those of the checkpoint, bit by bit.

    Raises:
        InputError: nothing is asked for, or a tensor has no published name.
    """
    require(vggt is not None or release is not None, "vggt", "vggt=<file>, release=<file> or both", None)
    state = model_state(read_checkpoint(checkpoint))
    encoder = {name: tensor for name, tensor in state.items() if name.startswith("encoder.")}
    heads = {name: tensor for name, tensor in state.items() if name not in encoder}
    report = []
    for path, own, table, entry in (
        (vggt, encoder, names.VGGT, None),
        (release, heads, names.RELEASE, names.RELEASE_ENTRY),
    ):
        if path is not None:
            tensors = {_published(checkpoint, name, table): tensor for name, tensor in own.items()}
            write_aside(
                path, lambda aside, t=tensors, e=entry, p=path: write_tensors(Path(p).suffix, aside, t, e)
            )
            report.append(f"{path}: {len(tensors)} tensors")
    return report


def _published(checkpoint: str | Path, name: str, table: Mapping[str, str]) -> str:
    published = names.to_published(name, table)
    if published is None:
        raise InputError(
            f"{checkpoint}: {name}: expected a tensor that the release has; found one of our own"
        )
    return published


def write_tensors(suffix: str, path: Path, tensors: dict[str, Tensor], entry: str | None) -> None:
    if suffix == ".safetensors":
        require(entry is None, "release", f"a PyTorch file (.pth), which holds {entry!r}", suffix)
        save_file(tensors, path, metadata={"format": "pt"})
    else:
        content: Any = tensors if entry is None else {entry: tensors}
        torch.save(content, path)
