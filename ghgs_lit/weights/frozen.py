"""Frozen weights, stored once in a file that all checkpoints of a run share."""

import contextlib
import hashlib
import os
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ghgs_lit.errors import InputError, require
from ghgs_lit.files import write_atomically
from ghgs_lit.weights.reading import file_of, open_file, require_dense

#: Largest size in bytes of frozen weights that each checkpoint stores itself.
OWN = 1 << 26
#: Version of checkpoints that share a file; readers of version 2 would miss its tensors.
SHARING = 3
PATTERN = "frozen-*.pt"  #: Names of the files


def digest_of(tensors: Mapping[str, Tensor]) -> str:
    """SHA-256, in hexadecimal digits, of names, dtypes, shapes and bytes; independent of the order."""
    digest = hashlib.sha256()
    for name in sorted(tensors):
        tensor = tensors[name].detach().cpu().contiguous()
        digest.update(f"{name} {tensor.dtype} {tuple(tensor.shape)};".encode())
        digest.update(tensor.reshape(-1).view(torch.uint8).numpy())
    return digest.hexdigest()


class Frozen:
    """Moves the tensors listed under a checkpoint's ``frozen`` into a shared file."""

    def __init__(self) -> None:
        self._known: list[tuple[str, int, int]] = []
        self._digest = ""

    def stored(self, checkpoint: dict[str, Any], folder: Path) -> dict[str, Any]:
        """Replace the frozen tensors of a checkpoint by a reference to the shared file.

        Args:
            checkpoint: its ``frozen`` lists names of some of its tensors.
            folder: folder of the checkpoint; the shared file is written there if it is new.

        Returns:
            The content to write; ``checkpoint`` unchanged if frozen tensors are small
            (:data:`OWN`).
        """
        state = checkpoint.get("state_dict", {})
        tensors = {name: state[name] for name in checkpoint.get("frozen", ())}
        if sum(tensor.nbytes for tensor in tensors.values()) <= OWN:
            return checkpoint
        known = [(name, tensor.data_ptr(), tensor._version) for name, tensor in tensors.items()]
        if known != self._known:  # hash again only if the tensors have changed
            self._known = known
            self._digest = digest_of(tensors)
        path = folder / PATTERN.replace("*", self._digest[:16])
        if not path.exists():
            _write(path, tensors)
        return {
            **checkpoint,
            "state_dict": {name: value for name, value in state.items() if name not in tensors},
            "frozen_file": {"name": path.name, "sha256": self._digest},
            "format_version": SHARING,
        }


def _write(path: Path, tensors: Mapping[str, Tensor]) -> None:
    """Write the file, or hard-link the same file of another run of the sweep."""
    for twin in path.parent.parent.parent.glob(f"*/{path.parent.name}/{path.name}"):
        with contextlib.suppress(OSError):  # some file systems have no links
            return write_atomically(path, partial(os.link, twin))
    write_atomically(path, partial(torch.save, dict(tensors)))


def join_frozen(path: str | Path, checkpoint: Mapping[str, Any], whole: bool = False) -> dict[str, Any]:
    """Add the tensors of its shared file, if any, to the content of a checkpoint.

    Args:
        path: path that the checkpoint was read from.
        checkpoint: its content.
        whole: check the SHA-256 of the shared tensors.

    Raises:
        InputError: the shared file is missing from the checkpoint's folder, or has other content.
    """
    if "frozen_file" not in checkpoint:
        return dict(checkpoint)
    place = f"{path}: frozen_file"
    linked = checkpoint["frozen_file"]
    fits = isinstance(linked, Mapping) and all(isinstance(linked.get(k), str) for k in ("name", "sha256"))
    require(fits, place, "a mapping of name and sha256", linked)
    name = linked["name"]
    sha256 = linked["sha256"]
    require(Path(name).name == name, place, "the name of a file beside the checkpoint", name)
    file = file_of(path).resolve().with_name(name)
    if not file.is_file():
        advice = "`ghgs export inference=<file>` makes one file of both"
        raise InputError(f"{place}: expected its frozen weights {name} beside it ({advice}); found none")
    tensors = open_file(file)
    if isinstance(tensors, Mapping):
        require_dense(tensors, file)
    fits = isinstance(tensors, Mapping) and all(isinstance(value, Tensor) for value in tensors.values())
    if not fits or list(tensors) != checkpoint.get("frozen") or (whole and digest_of(tensors) != sha256):
        raise InputError(f"{place}: expected {file} with SHA-256 {sha256[:16]}... of weights; found others")
    return {**checkpoint, "state_dict": {**tensors, **checkpoint["state_dict"]}}
