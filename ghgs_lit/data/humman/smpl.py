"""Bodies from SMPL parameters, for those who have the licensed model.

HuMMan stores parameters, not vertices: vertices need SMPL_NEUTRAL and the package ``smplx``. The model file
is read without running it: pickles of the official release name chumpy and SciPy classes, which are replaced
by harmless classes that keep the arrays.
"""

import contextlib
import functools
import importlib
import io
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy import sparse

from ghgs_lit.data.decoding import check_array
from ghgs_lit.data.pickles import load_pickle
from ghgs_lit.errors import InputError, installed

VERTICES = 6890
#: What a sequence's ``smpl_params/<frame>.npz`` holds.
PARAMETERS = {"betas": 10, "body_pose": 69, "global_orient": 3, "transl": 3}
_SHAPES = {
    "v_template": (VERTICES, 3), "shapedirs": (VERTICES, 3, None), "posedirs": (VERTICES, 3, 207),
    "J_regressor": (24, VERTICES), "kintree_table": (2, 24), "weights": (VERTICES, 24), "f": (None, 3),
}  # fmt: skip
_FILES = ("smpl/SMPL_NEUTRAL.pkl", "smpl/SMPL_NEUTRAL.npz", "SMPL_NEUTRAL.pkl", "SMPL_NEUTRAL.npz")


class _Chumpy:
    """Replaces ``chumpy.ch.Ch``: an array under ``x``."""

    def __setstate__(self, state: dict) -> None:
        self.array = np.asarray(state["x"])


class _Sparse:
    """Replaces SciPy's compressed column matrices."""

    def __setstate__(self, state: dict) -> None:
        parts = (state["data"], state["indices"], state["indptr"])
        self.array = sparse.csc_matrix(parts, shape=state["_shape"]).toarray()


def _reconstruct(kind: type, base: type, state: Any) -> object:
    """How protocols below 2 make objects; only the replacements above are made."""
    if kind not in (_Chumpy, _Sparse):
        raise pickle.UnpicklingError(f"an object of {kind!r}")
    return kind.__new__(kind)


_REPLACEMENTS = {
    ("chumpy.ch", "Ch"): _Chumpy,
    **{(f"scipy.sparse.{module}", "csc_matrix"): _Sparse for module in ("csc", "_csc")},
    **{(module, "_reconstructor"): _reconstruct for module in ("copy_reg", "copyreg")},
    **{(module, "object"): object for module in ("__builtin__", "builtins")},
}


def model_file(path: Path) -> Path:
    """The model's file: ``path`` itself, or one of the usual names in the folder ``path``. InputError: there
    is none."""
    files = [path, *(path / name for name in _FILES)]
    found = next((file for file in files if file.is_file()), None)
    if found is None:
        raise InputError(f"{path}: expected SMPL_NEUTRAL.pkl, or a folder with {_FILES[0]}; found neither")
    return found


def read_model(path: Path) -> dict[str, np.ndarray]:
    """The arrays of an SMPL model file. InputError: it is missing, names anything that could run, or an array
    is missing or has another shape."""
    if path.suffix == ".npz":
        with _opened(path) as archive:
            content = {key: archive[key] for key in _SHAPES if key in archive}
    else:
        content = load_pickle(path, also=_REPLACEMENTS)
    if not isinstance(content, dict):
        raise InputError(f"{path}: expected the arrays of an SMPL model; found {type(content).__name__}")
    arrays = {key: getattr(content.get(key), "array", content.get(key)) for key in _SHAPES}
    return {key: check_array(f"{path}: {key}", arrays[key], [shape]) for key, shape in _SHAPES.items()}


def read_parameters(path: Path) -> dict[str, np.ndarray]:
    """Parameters of one frame, each a vector of float64. InputError: the file is missing or broken; a vector
    is missing, has another length or is not finite."""
    if not path.is_file():
        raise InputError(f"{path}: expected SMPL parameters; found no such file")
    with _opened(path) as archive:
        found = {key: archive[key] for key in PARAMETERS if key in archive}
    for key in PARAMETERS:
        if key not in found:
            raise InputError(f"{path}: expected {key}; found {sorted(found)}")
    return {key: check_array(f"{path}: {key}", np.ravel(found[key]), [(n,)]) for key, n in PARAMETERS.items()}


@contextlib.contextmanager
def _opened(path: Path):
    """Open an ``.npz``; every error, also one inside the block, becomes an InputError."""
    try:
        with np.load(path, allow_pickle=False) as archive:
            yield archive
    except Exception as error:  # zipfile, zlib and NumPy raise many types
        raise InputError(f"{path}: expected an .npz file of arrays; found {error}") from error


class Body:
    """SMPL_NEUTRAL from the file or folder ``path``. InputError: there is no model at ``path``, it is broken,
    or ``smplx`` is not installed."""

    def __init__(self, path: Path) -> None:
        self.model = _model(model_file(path))

    @torch.no_grad()
    def vertices(self, parameters: dict[str, np.ndarray]) -> np.ndarray:
        """[6890, 3] float32 in the parameters' frame; ``global_orient`` turns about the pelvis."""
        tensors = {key: torch.from_numpy(value).float()[None] for key, value in parameters.items()}
        return self.model(**tensors).vertices[0].numpy()


@functools.lru_cache(maxsize=1)
def _model(path: Path) -> torch.nn.Module:
    smplx = installed("smplx", "smpl", "data.body")
    struct = importlib.import_module("smplx.utils").Struct(**read_model(path))
    with contextlib.redirect_stdout(io.StringIO()):  # it prints how many shapes the model has
        return smplx.SMPL("", data_struct=struct, gender="neutral").eval()
