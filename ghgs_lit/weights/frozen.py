"""Frozen weights, which all checkpoints of a run share in one file beside them."""

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

#: Bytes of frozen weights up to which each checkpoint holds its own.
OWN = 1 << 26
#: Version of checkpoints that share a file; readers of version 2 would miss its tensors.
SHARING = 3
PATTERN = "frozen-*.pt"  #: Names of the files


def digest_of(tensors: Mapping[str, Tensor]) -> str:
    """SHA-256 of names, dtypes, shapes and bytes.

    Args:
        tensors: by name, in any order.

    Returns:
        64 hexadecimal digits.
    """
    digest = hashlib.sha256()
    for name in sorted(tensors):
        tensor = tensors[name].detach().cpu().contiguous()
        digest.update(f"{name} {tensor.dtype} {tuple(tensor.shape)};".encode())
        digest.update(tensor.reshape(-1).view(torch.uint8).numpy())
    return digest.hexdigest()


class Frozen:
    """Moves the tensors that a checkpoint names under ``frozen`` into a shared file."""

    def __init__(self) -> None:
        self._known: list[tuple[str, int, int]] = []
        self._digest = ""

    def stored(self, checkpoint: dict[str, Any], folder: Path) -> dict[str, Any]:
        """A checkpoint with a reference to the shared file in place of its frozen tensors.

        Args:
            checkpoint: whose ``frozen`` names some of its tensors.
            folder: that the checkpoint will be in; the shared file is written there if it is new.

        Returns:
            The content to write; ``checkpoint`` unchanged if frozen tensors are small
            (:data:`OWN`).
        """
        state = checkpoint.get("state_dict", {})
        tensors = {name: state[name] for name in checkpoint.get("frozen", ())}
        if sum(tensor.nbytes for tensor in tensors.values()) <= OWN:
            return checkpoint
        known = [(name, tensor.data_ptr(), tensor._version) for name, tensor in tensors.items()]
        if known != self._known:  # hashed again only if something wrote to them
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
    """Write the file, or link the same file of a neighbouring run of a sweep."""
    for twin in path.parent.parent.parent.glob(f"*/{path.parent.name}/{path.name}"):
        with contextlib.suppress(OSError):  # some file systems have no links
            return write_atomically(path, partial(os.link, twin))
    write_atomically(path, partial(torch.save, dict(tensors)))


def joined(path: str | Path, checkpoint: Mapping[str, Any], whole: bool = False) -> dict[str, Any]:
    """A checkpoint with the tensors of its shared file, if any.

    Args:
        path: that the checkpoint was read from.
        checkpoint: its content.
        whole: check the SHA-256 of the shared tensors.

    Returns:
        The content with all tensors.

    Raises:
        InputError: there is no such file beside the checkpoint, or it holds something else.
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
