"""Files of features on disk: by key, of bounded size, shared by runs."""

import hashlib
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from ghgs_lit.files import write_atomically

DTYPES = {"float32": torch.float32, "float16": torch.float16, "bfloat16": torch.bfloat16}

#: Tensors of a file by name, and its metadata.
Stored = tuple[dict[str, Tensor], dict[str, str]]


class FeatureFiles:
    """Reads features from ``directory``, or makes them and writes them there.

    What comes back is always what the file holds, so that the first run and all others see the same. Files
    are written atomically: runs may share a directory. A file that cannot be read is written again.

    Args:
        directory: created where it does not exist.
        dtype: of the files, a key of :data:`DTYPES`.
        max_gb: size of all files, 10^9 bytes; beyond it the oldest are deleted. None: no limit.
    """

    def __init__(self, directory: str | Path, dtype: str = "float32", max_gb: float | None = None):
        self.directory, self.dtype = Path(directory), dtype
        self.limit = None if max_gb is None else int(1e9 * max_gb)
        self.hits = self.made = self.written = self.deleted = 0
        # Bytes of all files: other runs may write too, so it is counted again before anything is deleted.
        self._bytes = 0 if self.limit is None else _bytes(self._files())
        self._versions: list = []
        self._hash = ""

    @property
    def content(self) -> str:
        """What the files hold, for the report."""
        raise NotImplementedError

    def report(self) -> str:
        """One line: how much was found and made, and the size of the cache."""
        files = self._files()
        size = _bytes(files)
        return (
            f"feature cache {self.directory}: {self.hits} found, {self.made} made"
            f" ({self.written / 1e6:.1f} MB; {self.content}, {self.dtype});"
            f" {len(files)} files, {size / 1e6:.1f} MB in all"
            + (f"; {self.deleted} old ones deleted (feature_cache.max_gb)" if self.deleted else "")
        )

    def stored(self, key: str, make: Callable[[], Stored]) -> Stored:
        """The content of the file of ``key``; where there is none, of a new one with what ``make`` gives."""
        path = self.directory / key[:2] / f"{key}.safetensors"
        content = _read(path)
        if content is not None:
            self.hits += 1
            return content
        with torch.no_grad():
            content = make()
        size = _write(path, *content)
        self.written += size
        self._bytes += size
        self.made += 1
        if self.limit is not None and self._bytes > self.limit:
            self._delete_oldest(path)
        return content

    def in_files_dtype(self, tensors: dict[str, Tensor]) -> Stored:
        """Tensors as a file holds them, and their own dtypes."""
        facts = {name: str(value.dtype).removeprefix("torch.") for name, value in tensors.items()}
        return {
            name: value.to(DTYPES[self.dtype]).cpu().contiguous() for name, value in tensors.items()
        }, facts

    def fingerprint(self, module: nn.Module) -> str:
        """Hash of the weights of ``module``, always the same one; computed again when one has changed."""
        # A change in place raises a tensor's version; another tensor has another address.
        state = module.state_dict(keep_vars=True)
        versions = [(t.data_ptr(), t._version, t.dtype) for t in state.values()]
        if versions != self._versions:
            named = sorted(state.items())
            self._versions, self._hash = versions, hashed([name for name, _ in named], [t for _, t in named])
        return self._hash

    def _files(self) -> list[Path]:
        return list(self.directory.glob("*/*.safetensors"))

    def _delete_oldest(self, newest: Path) -> None:
        """Delete the files that were written first, until a tenth of the limit is free; keep ``newest``."""
        files = sorted((file for file in self._files() if file != newest), key=_stat)
        self._bytes = _bytes([newest, *files])
        for file in files:
            if self._bytes <= 0.9 * self.limit:
                break
            self._bytes -= _bytes([file])
            file.unlink(missing_ok=True)
            self.deleted += 1


def hashed(facts: Any, tensors: Sequence[Tensor]) -> str:
    """Hash of plain data and of the bytes of tensors."""
    digest = hashlib.sha256(json.dumps(facts, sort_keys=True, default=list).encode())
    for tensor in tensors:
        digest.update(json.dumps([str(tensor.dtype), list(tensor.shape)]).encode())
        digest.update(tensor.detach().cpu().contiguous().view(torch.uint8).numpy())
    return digest.hexdigest()


def _stat(file: Path) -> tuple[float, int]:
    """When a file was written, and its bytes; 0 where another run has deleted it."""
    try:
        found = file.stat()
    except FileNotFoundError:
        return 0.0, 0
    return found.st_mtime, found.st_size


def _bytes(files: Sequence[Path]) -> int:
    return sum(_stat(file)[1] for file in files)


def _read(path: Path) -> Stored | None:
    """The content of a file; None where there is none or it is broken."""
    try:
        with safe_open(path, framework="pt") as file:
            return {name: file.get_tensor(name) for name in file.keys()}, dict(file.metadata())  # noqa: SIM118
    except FileNotFoundError:
        return None
    except (SafetensorError, OSError) as error:
        print(f"{path}: expected a whole file of features; {error}; it is written again", flush=True)
        return None


def _write(path: Path, tensors: dict[str, Tensor], facts: dict[str, str]) -> int:
    write_atomically(path, lambda temporary: save_file(tensors, temporary, metadata=facts))
    return path.stat().st_size
