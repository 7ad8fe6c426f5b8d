"""Reading of safetensors and PyTorch files, with one-line errors for any other file.

Tensors are memory-mapped: only pages in use take memory, and the system can free them.
"""

import pickle
import re
import warnings
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ghgs_lit.errors import InputError
from ghgs_lit.files import resolve_path

if TYPE_CHECKING:  # a missing file is reported without importing PyTorch
    from torch import Tensor

#: Name of the checkpoint that comes with the package (docs/model_card.md).
SHIPPED = "shipped"
#: Path of that checkpoint.
SHIPPED_FILE = Path(__file__).with_name("shipped.ckpt")
ZIP = b"PK"  #: First bytes of a PyTorch file
PICKLE = b"\x80"  #: First byte of a file of PyTorch before 1.6
_ENCRYPTED = 1  # flag bit of a ZIP record
_FLOATS = ("float64", "float32", "float16", "bfloat16")  # allowed dtypes of weights


def file_of(path: str | Path) -> Path:
    """Resolve :data:`SHIPPED`, or the folder of a run (its last checkpoint), to a file."""
    file = SHIPPED_FILE if str(path) == SHIPPED else Path(path).expanduser()
    last = file / "checkpoints" / "last.ckpt"
    return last if last.is_file() else file


def open_file(path: str | Path, whole: bool = False) -> Any:
    """Read a safetensors or PyTorch file, recognised by its first bytes.

    No code in it is executed (``weights_only=True``).

    Args:
        path: path of the file, :data:`SHIPPED`, or the folder of a run, meaning its last checkpoint.
        whole: read every byte of a PyTorch file once and reject a damaged one (2 s for 1 GB).

    Returns:
        The content; tensors are memory-mapped, except in files of PyTorch before 1.6.

    Raises:
        FileNotFoundError: there is no such file.
        InputError: it has another format, is truncated or damaged, or contains code.
    """
    path = file_of(path)
    start = require_weights(path)
    if start.startswith(ZIP):
        if not zipfile.is_zipfile(path):
            raise _unfit(path, "the beginning of a PyTorch file whose end is missing (truncated)")
        require_records(path, whole)
        return _open_torch(path, mmap=True)
    if start.startswith(PICKLE):  # files of PyTorch before 1.6 cannot be mapped
        return _open_torch(path, mmap=False)
    if start[8:9] == b"{":
        return _open_safetensors(path)
    raise _unfit(path, f"neither; its first bytes are {start[:16]!r}")


def _unfit(path: Path, found: str) -> InputError:
    return InputError(f"{path}: expected weights as safetensors or a PyTorch file; found {found}")


def require_weights(path: str | Path) -> bytes:
    """Return up to 64 first bytes of a file that may hold weights.

    Args:
        path: as for :func:`open_file`.

    Raises:
        FileNotFoundError: there is no such file.
        InputError: it is a directory, or empty.
    """
    path = file_of(path)
    if path.is_dir():
        raise _unfit(path, "a directory")
    if not path.is_file():
        resolve_path(path)  # rejects cyclic links
        raise FileNotFoundError(f"{path}: expected a file of weights; found none")
    with path.open("rb") as file:
        start = file.read(64)
    if not start:
        raise _unfit(path, "an empty file")
    return start


def require_records(path: Path, whole: bool) -> None:
    """Reject a PyTorch file with compressed or encrypted records, which PyTorch does not write, or with
    wrong checksums.

    Memory-mapped, compressed records would give wrong numbers; unpacked, they may fill the memory.

    Args:
        path: path of a file in ZIP format.
        whole: check the checksums of tensors, too.

    Raises:
        InputError: a record is compressed, encrypted or damaged, or records claim more bytes than
            the file has.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            records = archive.infolist()
            for record in records:
                is_stored = record.compress_type == zipfile.ZIP_STORED
                is_stored &= record.compress_size == record.file_size
                if not is_stored or record.flag_bits & _ENCRYPTED:
                    raise _unfit(path, f"a compressed or encrypted record ({record.filename})")
            claimed = sum(record.file_size for record in records)
            size = path.stat().st_size
            if claimed > size:
                raise _unfit(path, f"records of {claimed} bytes in a file of {size}")
            for record in records:
                if whole or "/data/" not in record.filename:
                    with archive.open(record) as stream:
                        while stream.read(1 << 24):
                            pass
    except InputError:
        raise
    except (zipfile.BadZipFile, EOFError, ValueError, NotImplementedError, RuntimeError) as error:
        raise _unfit(path, f"one that was damaged ({error})") from error


def _open_torch(path: Path, mmap: bool) -> Any:
    import torch

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # foreign pickles are rejected below
            return torch.load(path, map_location="cpu", weights_only=True, mmap=mmap)
    except Exception as error:
        text = str(error)
        found = f"one that cannot be read ({(text.strip() or type(error).__name__).splitlines()[0]})"
        if isinstance(error, pickle.UnpicklingError):
            name = re.search(r"GLOBAL ([\w.]+)", text)
            found = f"a pickle with code ({name[1] if name else 'not of PyTorch'}), which is never run"
        raise _unfit(path, found) from error


def _open_safetensors(path: Path) -> "dict[str, Tensor]":
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    try:
        return load_file(path)
    except SafetensorError as error:
        raise _unfit(path, f"one that cannot be read ({error})") from error


def require_dense(tensors: "Mapping[str, Any]", path: str | Path) -> None:
    """Reject tensors that weights cannot be: sparse ones, floats of 8 bits, and expanded ones.

    An expanded tensor stores fewer numbers than its shape implies, and a copy would use unlimited
    memory.

    Args:
        tensors: tensors by name; values of other types are ignored.
        path: path of their file, for messages.

    Raises:
        InputError: the message names the file and the tensor.
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
