"""Options and reader of HuMMan-Recon v1.0.

``<root>/p<subject>_a<action>/`` contains, for the Kinects 000 to 009 and frames that are multiples of 6
(some are missing)::

    kinect_color/kinect_<k>/<frame>.png   images, 1920 x 1080
    kinect_mask/kinect_<k>/<frame>.png    masks from matting: all values except 0 are the performer
    smpl_params/<frame>.npz               parameters of the SMPL body
    cameras.json                          for each ``kinect_color_<k>`` K (3, 3), R (3, 3) and T (3) as in
                                          OpenCV, world to camera, metres, without lens distortion
"""

import contextlib
import functools
import importlib
import io
import logging
import pickle
import re
from pathlib import Path, PurePosixPath
from typing import Any, ClassVar

import numpy as np
import torch
from pydantic import Field
from scipy import sparse

from ghgs_lit.config.options import Options, PathText, Size, Text
from ghgs_lit.data.dataset import DataSet
from ghgs_lit.data.decoding import check_array
from ghgs_lit.data.frames import Camera, Frame, FrameReader, read_camera, spread
from ghgs_lit.data.pickles import load_pickle
from ghgs_lit.errors import InputError, import_optional
from ghgs_lit.parsing import find_path, read_json, require_file

log = logging.getLogger(__name__)

KINECTS = range(10)
#: Frame numbers of a sequence; those that it lacks are skipped.
FRAMES = range(0, 97, 6)
# Smallest and largest plausible distance in metres between the cameras of a studio.
_NEAREST = 0.1
_FURTHEST = 100.0
_SEQUENCE = re.compile(r"p\d{6}_a\d{6}")

#: Folder of the images.
_COLOR = "kinect_color"


def read_cameras(path: Path) -> list[Camera]:
    """Read the ten colour cameras of a sequence from its ``cameras.json``.

    Raises:
        InputError: the file or a camera is missing or wrong, or translations are not in metres.
    """
    content = read_json(path, "the cameras of a sequence in JSON")
    cameras = []
    for k in KINECTS:
        key = f"kinect_color_{k:03d}"
        cameras.append(read_camera(f"{path}: {key}", content.get(key) if isinstance(content, dict) else None))
    apart = spread(cameras)
    if not _NEAREST < apart < _FURTHEST:
        raise InputError(f"{path}: expected translations T in metres; found cameras {apart:.4g} m apart")
    return cameras


class HuMManReader(FrameReader):
    """Reader of HuMMan frames; missing frames, and missing cameras of a frame, are skipped."""

    calibration = "cameras.json"

    def __init__(self, data: "HuMMan", phase: str) -> None:
        sequences = [(name, FRAMES) for name in data.sequences(phase)]
        super().__init__(data.folder, phase, sequences, "p000455_a000986")
        self._model = None if data.smpl_model is None else load_model(Path(data.smpl_model).expanduser())

    def frames_of(self, folder: Path, wanted: range) -> list[Frame]:
        cameras = read_cameras(folder / self.calibration)
        positions: dict[int, tuple[int, ...]] = {}
        for k in KINECTS:
            images = folder / _COLOR / f"kinect_{k:03d}"
            for path in images.iterdir() if images.is_dir() else ():
                if path.suffix.lower() == ".png" and path.stem.isdecimal() and int(path.stem) in wanted:
                    number = int(path.stem)
                    positions[number] = (*positions.get(number, ()), k)
        if not positions:
            raise InputError(
                f"{folder / _COLOR}: expected frames such as {wanted[0]:06d}.png; found none "
                f"of {len(wanted)} (frame numbers are multiples of 6)"
            )
        frames = []
        for number, kinects in sorted(positions.items()):
            if len(kinects) < len(KINECTS):
                lacking = sorted(set(KINECTS) - set(kinects))
                log.warning("%s: frame %06d lacks kinects %s, left out", folder, number, lacking)
            names = [PurePosixPath(f"kinect_{k:03d}/{number:06d}.png") for k in KINECTS]
            frames.append(Frame(folder, number, cameras, kinects, names))
        return frames

    def photograph(self, frame: Frame, position: int) -> Path:
        return self._file(frame, _COLOR, position)

    def mask(self, frame: Frame, position: int) -> Path:
        return self._file(frame, "kinect_mask", position)

    def _file(self, frame: Frame, kind: str, position: int) -> Path:
        path = frame.folder / kind / frame.photographs[position]
        return find_path(path.parent, path.name) or path

    def body_place(self, name: str) -> Path | str:
        frame = self.frames[name]
        file = frame.folder / "smpl_params" / f"{frame.number:06d}.npz"
        return "data.smpl_model" if self._model is None else file

    def read_body(self, name: str) -> np.ndarray | None:
        if self._model is None:
            return None
        return body_vertices(self._model, read_parameters(self.body_place(name)))


class Split(Options):
    """Sequences for validation; all others that exist are for training."""

    val: tuple[Text, ...] = Field(min_length=1)
    """Names of sequences."""


class HuMMan(DataSet):
    """Downloaded HuMMan-Recon sequences below ``root``; each frame of a sequence is a subject."""

    static_cameras: ClassVar[bool] = True
    ring: ClassVar[int] = len(KINECTS)

    name: Text = "humman"
    size: Size = (360, 640)
    split: Split
    """Sequences of each phase."""
    smpl_model: PathText | None = None
    """The licensed SMPL_NEUTRAL.pkl, or a folder with smpl/SMPL_NEUTRAL.pkl, whose vertices are the
    bodies; requires the package smplx. Null: no bodies; train with loss.weights.chamfer=0."""

    def sequences(self, phase: str) -> list[str]:
        """Names of the sequences of a phase; those of ``val`` need not exist."""
        if phase == "val":
            return list(self.split.val)
        names = (p.name for p in self.folder.iterdir() if p.is_dir() and _SEQUENCE.fullmatch(p.name))
        return sorted(set(names) - set(self.split.val))

    def has(self, phase: str) -> bool:
        return len(self.sequences(phase)) > 0

    def reader(self, phase: str) -> HuMManReader:
        return HuMManReader(self, phase)


# SMPL: bodies from parameters, with the licensed SMPL_NEUTRAL and the package ``smplx``. No code of the
# model file is run: chumpy's and SciPy's classes in the pickles of the official release are replaced by
# harmless ones that only keep the arrays.

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


@functools.lru_cache(maxsize=1)
def load_model(path: Path) -> torch.nn.Module:
    """Load the body model SMPL_NEUTRAL.

    Args:
        path: its file, or a folder that contains ``smpl/SMPL_NEUTRAL.pkl``.

    Raises:
        InputError: the file is missing or bad, or ``smplx`` is not installed.
    """
    file = path / _FILE if path.is_dir() else path
    if not file.is_file():
        raise InputError(f"{path}: expected SMPL_NEUTRAL.pkl, or a folder with {_FILE}; found neither")
    smplx = import_optional("smplx", "smpl", "data.smpl_model")
    struct = importlib.import_module("smplx.utils").Struct(**read_model(file))
    with contextlib.redirect_stdout(io.StringIO()):  # smplx prints the number of shape components
        return smplx.SMPL("", data_struct=struct, gender="neutral").eval()


@torch.no_grad()
def body_vertices(model: torch.nn.Module, parameters: dict[str, np.ndarray]) -> np.ndarray:
    """Vertices [6890, 3] float32 in the coordinates of the parameters; ``global_orient`` rotates about the
    pelvis.

    Args:
        parameters: result of :func:`read_parameters`.
    """
    tensors = {key: torch.from_numpy(value).float()[None] for key, value in parameters.items()}
    return model(**tensors).vertices[0].numpy()
