"""Bodies from HuMMan's SMPL parameters, with the licensed SMPL_NEUTRAL and the package ``smplx``.

No code of the model file is run: chumpy's and SciPy's classes in the pickles of the official release are
replaced by harmless ones that only keep the arrays.
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
from ghgs_lit.errors import InputError, import_optional
from ghgs_lit.parsing import require_file

VERTICES = 6890
#: Length of each vector in ``smpl_params/<frame>.npz``.
PARAMETERS = {"betas": 10, "body_pose": 69, "global_orient": 3, "transl": 3}
_SHAPES = {
    "v_template": (VERTICES, 3), "shapedirs": (VERTICES, 3, None), "posedirs": (VERTICES, 3, 207),
    "J_regressor": (24, VERTICES), "kintree_table": (2, 24), "weights": (VERTICES, 24), "f": (None, 3),
}  # fmt: skip
_FILE = "smpl/SMPL_NEUTRAL.pkl"


class _Chumpy:
    """Replacement for ``chumpy.ch.Ch``, whose array is ``x``."""

    def __setstate__(self, state: dict) -> None:
        self.array = np.asarray(state["x"])


class _Sparse:
    """Replacement for SciPy's ``csc_matrix``, which keeps a dense array."""

    def __setstate__(self, state: dict) -> None:
        parts = (state["data"], state["indices"], state["indptr"])
        self.array = sparse.csc_matrix(parts, shape=state["_shape"]).toarray()


def _reconstruct(kind: type, base: type, state: Any) -> object:
    """Construct an object as protocols below 2 do, for the replacements above only."""
    if kind not in (_Chumpy, _Sparse):
        raise pickle.UnpicklingError(f"an object of {kind!r}")
    return kind.__new__(kind)


_REPLACEMENTS = {
    ("chumpy.ch", "Ch"): _Chumpy,
    **{(f"scipy.sparse.{module}", "csc_matrix"): _Sparse for module in ("csc", "_csc")},
    **{(module, "_reconstructor"): _reconstruct for module in ("copy_reg", "copyreg")},
    **{(module, "object"): object for module in ("__builtin__", "builtins")},
}


def read_model(path: Path) -> dict[str, np.ndarray]:
    """Read the arrays of an SMPL model (Loper et al. 2015) from ``SMPL_NEUTRAL.pkl``.

    Raises:
        InputError: the file or an array is missing or bad, or the file refers to code.
    """
    content = load_pickle(path, also=_REPLACEMENTS)
    if not isinstance(content, dict):
        raise InputError(f"{path}: expected the arrays of an SMPL model; found {type(content).__name__}")
    arrays = {key: getattr(content.get(key), "array", content.get(key)) for key in _SHAPES}
    return {key: check_array(f"{path}: {key}", arrays[key], [shape]) for key, shape in _SHAPES.items()}


def read_parameters(path: Path) -> dict[str, np.ndarray]:
    """Read the vectors of :data:`PARAMETERS` of one frame from an ``.npz`` file, as float64.

    Raises:
        InputError: the file is missing or broken, or a vector is missing, has another length or is not
            finite.
    """
    require_file(path, "SMPL parameters")
    try:
        with np.load(path, allow_pickle=False) as archive:
            arrays = {key: archive[key] for key in PARAMETERS if key in archive}
    except Exception as error:  # zipfile, zlib and NumPy raise many types
        raise InputError(f"{path}: expected an .npz file of arrays; found {error}") from error
    for key in PARAMETERS:
        if key not in arrays:
            raise InputError(f"{path}: expected {key}; found {sorted(arrays)}")
    return {
        key: check_array(f"{path}: {key}", np.ravel(arrays[key]), [(n,)]) for key, n in PARAMETERS.items()
    }


class Body:
    """The body model SMPL_NEUTRAL.

    Args:
        path: its file, or a folder that contains ``smpl/SMPL_NEUTRAL.pkl``.

    Raises:
        InputError: the file is missing or bad, or ``smplx`` is not installed.
    """

    def __init__(self, path: Path) -> None:
        file = path / _FILE if path.is_dir() else path
        if not file.is_file():
            raise InputError(f"{path}: expected SMPL_NEUTRAL.pkl, or a folder with {_FILE}; found neither")
        self.file = file
        self.model = _model(file)

    @torch.no_grad()
    def vertices(self, parameters: dict[str, np.ndarray]) -> np.ndarray:
        """Vertices [6890, 3] float32 in the coordinates of the parameters; ``global_orient`` rotates about
        the pelvis.

        Args:
            parameters: result of :func:`read_parameters`.
        """
        tensors = {key: torch.from_numpy(value).float()[None] for key, value in parameters.items()}
        return self.model(**tensors).vertices[0].numpy()


@functools.lru_cache(maxsize=1)
def _model(path: Path) -> torch.nn.Module:
    smplx = import_optional("smplx", "smpl", "data.smpl_model")
    struct = importlib.import_module("smplx.utils").Struct(**read_model(path))
    with contextlib.redirect_stdout(io.StringIO()):  # smplx prints the number of shape components
        return smplx.SMPL("", data_struct=struct, gender="neutral").eval()
