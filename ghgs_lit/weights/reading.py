"""Reading of safetensors and PyTorch files, with one-line errors for any other file.

Tensors are mapped from the disk: only the pages that are used take memory,
and the system can free them.
"""

import pickle
import re
import warnings
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ghgs_lit.errors import InputError
from ghgs_lit.files import resolved

if TYPE_CHECKING:  # a missing file is refused before PyTorch is imported
    import torch
    from torch import Tensor

_WEB_PAGE = "a web page; the address asked for a login or redirected"
#: First bytes of what failed downloads leave, and their meaning.
FAILED_DOWNLOADS = (
    (b"version https://git-lfs", "a git-lfs pointer; `git lfs pull` downloads the file itself"),
    (b"<!doctype html", _WEB_PAGE),
    (b"<html", _WEB_PAGE),
    (b"<?xml", "an XML document, as servers send it for an error"),
)
#: Name of the checkpoint that comes with the package (docs/model_card.md).
SHIPPED = "shipped"
#: Its file.
SHIPPED_FILE = Path(__file__).with_name("shipped.ckpt")
ZIP = b"PK"  #: First bytes of a PyTorch file
PICKLE = b"\x80"  #: First byte of a file of PyTorch before 1.6
_ENCRYPTED = 1  # flag of a record
_FLOATS = ("float64", "float32", "float16", "bfloat16")  # precisions of weights

_CHUNK = 1 << 28  #: Bytes of tensors that are converted before the file is mapped again


def file_of(path: str | Path) -> Path:
    """The file of a checkpoint, which may be :data:`SHIPPED` or the folder of a run."""
    file = SHIPPED_FILE if str(path) == SHIPPED else Path(path).expanduser()
    last = file / "checkpoints" / "last.ckpt"
    return last if last.is_file() else file


def open_file(path: str | Path) -> Any:
    """Content of a safetensors or PyTorch file; the first bytes tell the format.

    No code in it is executed (``weights_only=True``).

    Args:
        path: of the file, :data:`SHIPPED`, or the folder of a run, whose last weights count.

    Returns:
        What the file holds; tensors are mapped from the disk,
        except in files of PyTorch before 1.6.

    Raises:
        FileNotFoundError: there is no such file.
        InputError: it has another format, is truncated, or holds code.
    """
    path = file_of(path)
    start = require_weights(path)
    if start.startswith(ZIP):
        if not zipfile.is_zipfile(path):
            raise _unfit(path, "the beginning of a PyTorch file whose end is missing (truncated)")
        require_stored(path)
        return _open_torch(path, mmap=True)
    if start.startswith(PICKLE):  # files of PyTorch before 1.6 cannot be mapped
        return _open_torch(path, mmap=False)
    if start[8:9] == b"{":
        return _open_safetensors(path)
    raise _unfit(path, f"neither; its first bytes are {start[:16]!r}")


def _unfit(path: Path, found: str) -> InputError:
    return InputError(f"{path}: expected weights as safetensors or a PyTorch file; found {found}")


def require_weights(path: str | Path) -> bytes:
    """First bytes of a file that may hold weights.

    Args:
        path: as for :func:`open_file`.

    Returns:
        Up to 64 bytes.

    Raises:
        FileNotFoundError: there is no such file.
        InputError: it is a directory, empty, or what a failed download leaves.
    """
    path = file_of(path)
    if path.is_dir():
        raise _unfit(path, "a directory")
    if not path.is_file():
        resolved(path)  # refuses links that form a loop
        raise FileNotFoundError(f"{path}: expected a file of weights; found none")
    with path.open("rb") as file:
        start = file.read(64)
    if not start:
        raise _unfit(path, "an empty file")
    for magic, meaning in FAILED_DOWNLOADS:
        if start.lstrip().lower().startswith(magic):
            raise _unfit(path, meaning)
    return start


def require_stored(path: Path) -> None:
    """Refuse a PyTorch file whose records are not stored as they are, as PyTorch writes them.

    Mapped from the disk, compressed ones would be other numbers,
    and unpacked they may fill the memory.

    Args:
        path: of a file in ZIP format.

    Raises:
        InputError: a record is compressed or encrypted,
            or records claim more bytes than the file has.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            records = archive.infolist()
    except (zipfile.BadZipFile, ValueError, NotImplementedError) as error:
        raise _unfit(path, f"one that cannot be read ({error})") from error
    for record in records:
        is_stored = record.compress_type == zipfile.ZIP_STORED and record.compress_size == record.file_size
        if not is_stored or record.flag_bits & _ENCRYPTED:
            raise _unfit(path, f"a compressed or encrypted record ({record.filename})")
    claimed = sum(record.file_size for record in records)
    size = path.stat().st_size
    if claimed > size:
        raise _unfit(path, f"records of {claimed} bytes in a file of {size}")


def _open_torch(path: Path, mmap: bool) -> Any:
    import torch

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # foreign pickles are refused below
            return torch.load(path, map_location="cpu", weights_only=True, mmap=mmap)
    except Exception as error:
        text = str(error)
        code = re.search(r"GLOBAL ([\w.]+)", text)
        if code:
            found = f"plain data mixed with code ({code[1]}), which is never run"
        elif isinstance(error, pickle.UnpicklingError):
            found = "a pickle that PyTorch did not write or that holds code, which is never run"
        else:
            found = f"one that cannot be read ({(text.strip() or type(error).__name__).splitlines()[0]})"
        raise _unfit(path, found) from error


def _open_safetensors(path: Path) -> "dict[str, Tensor]":
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, "pt") as file:
            return {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except SafetensorError as error:
        text = str(error)
        # "not fully covered": data is missing; "header length": a part of the header is missing.
        cut = "not fully covered" in text or "header length" in text
        why = "the beginning of a safetensors file whose end is missing (truncated)" if cut else text
        raise _unfit(path, why) from error


def require_dense(tensors: "Mapping[str, Any]", path: str | Path) -> None:
    """Refuse tensors that weights never are.

    They are sparse, of 8 bits, or of fewer stored numbers than their shape says, which a copy would
    expand without limit.

    Args:
        tensors: by name; values of other types are not looked at.
        path: of their file, for messages.

    Raises:
        InputError: names the file and the tensor.
    """
    import torch

    for name, value in tensors.items():
        if not isinstance(name, str):
            raise InputError(f"{path}: state_dict: expected names of tensors; found {name!r}")
        if not isinstance(value, torch.Tensor):
            continue
        dtype = str(value.dtype).removeprefix("torch.")
        known = value.layout is torch.strided and not value.is_meta
        known = known and (not value.is_floating_point() or dtype in _FLOATS)
        if not known:
            found = f"{value.dtype}, {value.layout} on {value.device}"
            raise InputError(f"{path}: {name}: expected a dense tensor of 16, 32 or 64 bits; found {found}")
        if value.nbytes > value.untyped_storage().nbytes():
            shape = tuple(value.shape)
            stored = value.untyped_storage().nbytes()
            raise InputError(f"{path}: {name}: expected as many bytes as {shape} takes; found {stored}")


def cast(
    open_tensors: "Callable[[], Mapping[str, Tensor]]", dtype_of: "Callable[[str, torch.dtype], torch.dtype]"
) -> "dict[str, Tensor]":
    """Tensors of a mapped file in other precisions.

    Pages that were read count as memory, so the file is mapped again after every 256 MB: only the
    result and one chunk are held.

    Args:
        open_tensors: maps the file and returns its tensors by name.
        dtype_of: a tensor's name and stored precision to the wanted one.

    Returns:
        Tensors by name, each converted unless it has its precision.
    """
    tensors = open_tensors()
    names = list(tensors)
    target = {name: dtype_of(name, tensor.dtype) for name, tensor in tensors.items()}
    changed = [name for name in names if tensors[name].dtype != target[name]]
    result: dict[str, Tensor] = {}
    used = 0
    for name in changed:
        if used > _CHUNK:
            tensors = {}
            used = 0
            tensors = open_tensors()
        used += tensors[name].nbytes
        result[name] = tensors[name].to(target[name])
    if changed:
        tensors = open_tensors() if len(result) < len(names) else {}
    return {name: result[name] if name in result else tensors[name] for name in names}
