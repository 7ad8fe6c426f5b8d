"""Safe reading of pickles of data sets.

The writer of a pickle decides what is called when it is loaded. This module admits arrays and plain
containers only, and rejects every other name before anything is called. It supports the names of NumPy 1
(``numpy.core``), NumPy 2 (``numpy._core``) and Python 2 (``__builtin__``); trimesh's subclass of arrays
is read as an array.
"""

import codecs
import collections
import io
import pickle
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy

from ghgs_lit.errors import InputError
from ghgs_lit.parsing import read_npy


def _bytes(text: str, encoding: str = "latin1") -> bytes:
    """Decode bytes as written by protocols below 3; other codecs are rejected."""
    if encoding not in ("latin1", "latin-1"):
        raise pickle.UnpicklingError(f"codec {encoding!r}")
    return codecs.encode(text, "latin1")


_ARRAY = np.zeros(0).__reduce__()[0]
_SCALAR = np.float64(0).__reduce__()[0]
_BUFFER = np.zeros(1).__reduce_ex__(5)[0]
_BUILTINS = (bool, bytearray, bytes, complex, dict, float, frozenset, int, list, set, str, tuple)

_ADMITTED: dict[tuple[str, str], Any] = {
    ("numpy", "dtype"): np.dtype,
    ("numpy", "ndarray"): np.ndarray,
    ("_codecs", "encode"): _bytes,
    ("collections", "OrderedDict"): collections.OrderedDict,
    ("trimesh.caching", "TrackedArray"): np.ndarray,
    ("trimesh.util", "TrackedArray"): np.ndarray,
    **{(f"numpy.{core}.multiarray", "_reconstruct"): _ARRAY for core in ("core", "_core")},
    **{(f"numpy.{core}.multiarray", "scalar"): _SCALAR for core in ("core", "_core")},
    **{(f"numpy.{core}.numeric", "_frombuffer"): _BUFFER for core in ("core", "_core")},
    **{("builtins", kind.__name__): kind for kind in _BUILTINS},
    **{("__builtin__", kind.__name__): kind for kind in _BUILTINS},
}


_NOTHING: Mapping[tuple[str, str], Any] = {}


class _Refused(pickle.UnpicklingError):
    """A name that is not admitted."""


class _Unpickler(pickle.Unpickler):
    def __init__(self, stream: io.BufferedIOBase, also: Mapping[tuple[str, str], Any]) -> None:
        super().__init__(stream, encoding="latin1")
        self._admitted = {**_ADMITTED, **also}

    def find_class(self, module: str, name: str) -> Any:
        try:
            return self._admitted[module, name]
        except KeyError:
            raise _Refused(f"{module}.{name}") from None


def _load(path: Path, stream: io.BufferedIOBase, also: Mapping[tuple[str, str], Any] = _NOTHING) -> Any:
    """Load a pickle with the admitted names, and with replacements ``also`` for further ones."""
    try:
        return _Unpickler(stream, also).load()
    except _Refused as error:
        raise InputError(
            f"{path}: expected a pickle of NumPy arrays and plain containers; found {error}"
        ) from None
    except Exception as error:  # broken pickles raise anything
        raise InputError(f"{path}: expected a readable pickle; found {error!r}") from error


def load_pickle(path: Path, also: Mapping[tuple[str, str], Any] = _NOTHING) -> Any:
    """Read the arrays, scalars and plain containers of a pickle.

    Args:
        also: harmless replacements for further names (module, name).

    Raises:
        InputError: the file is missing or broken, or contains any other name, which is not called.
    """
    if not path.is_file():
        raise InputError(f"{path}: expected a pickle; found no such file")
    with path.open("rb") as stream:
        return _load(path, stream, also)


def load_npy(path: Path) -> Any:
    """Read an ``.npy`` file, with its pickled objects as in :func:`load_pickle`.

    Returns:
        An array; for an array of objects without dimensions (``np.save`` of a dictionary), its object.

    Raises:
        InputError: the file is missing or broken, or contains anything except arrays and plain
            containers.
    """
    if not path.is_file():
        raise InputError(f"{path}: expected an .npy file; found no such file")
    try:
        with path.open("rb") as stream:
            version = npy.read_magic(stream)
            header = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
            if header(stream)[2].hasobject:
                content = _load(path, stream)
                return content.item() if isinstance(content, np.ndarray) and content.ndim == 0 else content
        return read_npy(path)
    except InputError:
        raise
    except Exception as error:  # headers are Python source, and its tokenizer raises many types
        raise InputError(f"{path}: expected a readable .npy file; found {error}") from error
