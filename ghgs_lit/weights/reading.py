"""Opens weight files of either kind and says in one line what is wrong with those that are none.

Tensors are mapped from the disk, not read: they take memory where they are touched, and the system may
take it back.
"""

import pickle
import re
import warnings
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor

from ghgs_lit.errors import InputError

#: What is found under the name of a weight file when a download went wrong: first bytes, what they mean.
MISTAKEN = (
    (b"version https://git-lfs", "a git-lfs pointer; `git lfs pull` fetches the file that it stands for"),
    (b"<!doctype html", "a web page; the address that it came from wanted a login or led elsewhere"),
    (b"<html", "a web page; the address that it came from wanted a login or led elsewhere"),
    (b"<?xml", "an XML document, as servers send it for an error"),
)
ZIP, PICKLE = b"PK", b"\x80"

#: Bytes of tensors to convert before a file is mapped anew.
_CHUNK = 1 << 28


def open_file(path: str | Path, map_location: Any = "cpu") -> Any:
    """What a ``.safetensors`` or PyTorch file holds, told by its content, whatever its name.

    Nothing in the file is ever executed (``weights_only=True``).

    Raises:
        FileNotFoundError: there is no such file.
        InputError: it is no such file, not a whole one, or holds code; one line.
    """
    path = Path(path)
    start = _first_bytes(path)
    if start.startswith(ZIP):
        if not zipfile.is_zipfile(path):
            raise _unfit(path, "the beginning of a PyTorch file whose end is missing (truncated)")
        return _open_torch(path, map_location, mmap=True)
    if start.startswith(PICKLE):  # files of PyTorch before 1.6 cannot be mapped
        return _open_torch(path, map_location, mmap=False)
    if start[8:9] == b"{":
        return _open_safetensors(path, map_location)
    raise _unfit(path, f"neither; its first bytes are {start[:16]!r}")


def _unfit(path: Path, found: str) -> InputError:
    return InputError(f"{path}: expected weights as safetensors or a PyTorch file; found {found}")


def _first_bytes(path: Path) -> bytes:
    if path.is_dir():
        raise _unfit(path, "a directory")
    if not path.is_file():
        raise FileNotFoundError(f"{path}: expected a file of weights; found none")
    with path.open("rb") as file:
        start = file.read(64)
    if not start:
        raise _unfit(path, "an empty file")
    for magic, meaning in MISTAKEN:
        if start.lstrip().lower().startswith(magic):
            raise _unfit(path, meaning)
    return start


def _open_torch(path: Path, map_location: Any, mmap: bool) -> Any:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about pickles that are none of PyTorch's; refused in a moment
            return torch.load(path, map_location=map_location, weights_only=True, mmap=mmap)
    except Exception as error:
        text = str(error)
        code = re.search(r"GLOBAL ([\w.]+)", text)
        if code:
            found = f"plain data that is mixed with code ({code[1]}), which is never run"
        elif isinstance(error, pickle.UnpicklingError):
            found = "a pickle that PyTorch did not write, or that holds code; such are never run"
        else:
            found = f"one that cannot be read ({(text.strip() or type(error).__name__).splitlines()[0]})"
        raise _unfit(path, found) from error


def _open_safetensors(path: Path, map_location: Any) -> dict[str, Tensor]:
    try:
        with safe_open(path, "pt", device=str(map_location)) as file:
            return {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except SafetensorError as error:
        text = str(error)
        # "not fully covered": the header announces more than follows; "header length": it breaks off itself.
        cut = "not fully covered" in text or "header length" in text
        why = "the beginning of a safetensors file whose end is missing (truncated)" if cut else text
        raise _unfit(path, why) from error


def cast(
    open_tensors: Callable[[], Mapping[str, Tensor]], dtype_of: Callable[[str, torch.dtype], torch.dtype]
) -> dict[str, Tensor]:
    """The tensors of a mapped file in the precision that ``dtype_of`` gives by name and stored precision.

    Tensors that are in it already stay mapped. A mapping counts as memory as far as it was touched, so
    where tensors are converted the file is closed and opened again every 256 MB: no more than the result
    and one chunk is ever held.
    """
    tensors = open_tensors()
    names = list(tensors)
    wanted = {name: dtype_of(name, tensor.dtype) for name, tensor in tensors.items()}
    changed = [name for name in names if tensors[name].dtype != wanted[name]]
    result: dict[str, Tensor] = {}
    used = 0
    for name in changed:
        if used > _CHUNK:
            tensors, used = {}, 0
            tensors = open_tensors()
        used += tensors[name].nbytes
        result[name] = tensors[name].to(wanted[name])
    tensors = {}
    if len(result) < len(names):
        tensors = open_tensors()
    return {name: result[name] if name in result else tensors[name] for name in names}
