"""Options and reader of ZJU-MoCap.

``<root>/CoreView_<id>/`` contains ``annots.npy``, the images of each camera, ``mask_cihp/`` (label maps: all
values except 0 are the subject), ``new_vertices/`` and ``vertices/`` (<frame number>.npy: 6890 x 3, metres,
world with z up).

``annots.npy`` is a pickled dictionary in an array without dimensions: ``cams`` with lists ``K`` (3, 3),
``D`` (4 or 5 coefficients in any shape), ``R`` (3, 3), ``T`` (3, 1) in **millimetres**, world to camera;
``ims`` with a dictionary for each frame, whose ``ims`` are the paths of its images in the order of the
cameras. In sequences 313 and 315 these are the original long names, whose fifth field is the frame number
from 1.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path, PurePath, PurePosixPath
from typing import Annotated, Any, ClassVar

import numpy as np
from pydantic import AfterValidator, Field, model_validator

from ghgs_lit.config.options import Count, Index, Options, Size, Text
from ghgs_lit.data.dataset import DataSet
from ghgs_lit.data.decoding import check_array, read_array
from ghgs_lit.data.frames import Camera, Frame, FrameReader, read_camera, spread
from ghgs_lit.data.pickles import load_npy
from ghgs_lit.errors import InputError
from ghgs_lit.parsing import find_path

MILLIMETRE = 0.001
# Distance in metres below which cameras were not given in millimetres.
_NEAREST = 0.1
BODY_VERTICES = 6890
#: Number of cameras used of each sequence, the first ones, which form the ring.
CAMERAS = 20
_MASKS = "mask_cihp"
#: Folders of vertices; the first one that exists is read.
_BODIES = ("new_vertices", "vertices")


def read_annotations(path: Path) -> tuple[list[Camera], list[tuple[PurePosixPath, ...]]]:
    """Read and check an ``annots.npy``.

    Returns:
        The cameras of the sequence, and for each frame the paths of their images.

    Raises:
        InputError: the file is missing, unsafe or broken, or an entry is bad.
    """
    content = load_npy(path)
    cams = _entry(path, content, "cams")
    ims = _entry(path, content, "ims")
    lists = {key: _entry(f"{path}: cams", cams, key) for key in ("K", "D", "R", "T")}
    counts = {key: len(values) for key, values in lists.items()}
    if len(set(counts.values())) != 1 or not counts["K"]:
        raise InputError(f"{path}: expected as many K, D, R and T in cams as cameras; found {counts}")
    cameras = []
    for k in range(counts["K"]):
        place = f"{path}: camera {k}"
        values = {key: values[k] for key, values in lists.items()}
        lens = check_array(f"{place}: D", np.ravel(values["D"]), [(4,), (5,)])
        if np.abs(lens).max() > 10:
            raise InputError(
                f"{place}: D: expected lens coefficients k1 k2 p1 p2 (k3); found {lens.tolist()}"
            )
        cameras.append(replace(read_camera(place, values, MILLIMETRE), distortion=lens))
    if len(cameras) > 1 and (apart := spread(cameras)) < _NEAREST:
        found = f"cameras within {apart / MILLIMETRE:.0f} mm of one another (metres?)"
        raise InputError(f"{path}: expected translations T in millimetres; found {found}")
    frames = [_photographs(f"{path}: frame {f}", entry, len(cameras)) for f, entry in enumerate(ims)]
    return cameras, frames


def _entry(place: Path | str, content: Any, key: str) -> Any:
    entry = content.get(key) if isinstance(content, Mapping) else None
    if entry is None or not isinstance(entry, (Mapping, Sequence, np.ndarray)):
        known = sorted(map(str, content)) if isinstance(content, Mapping) else type(content).__name__
        raise InputError(f"{place}: expected an entry {key!r}; found {known}")
    return entry


def _photographs(place: str, entry: Any, cameras: int) -> tuple[PurePosixPath, ...]:
    """Check the paths of a frame's images, in the order of the cameras: none may lead out of the sequence,
    and all must have the same frame number."""
    names = _entry(place, entry, "ims")
    if len(names) != cameras:
        raise InputError(f"{place}: expected a photograph for each of {cameras} cameras; found {len(names)}")
    photographs = tuple(PurePosixPath(str(name).replace("\\", "/")) for name in names)
    for name in photographs:
        if name.is_absolute() or ".." in name.parts:
            raise InputError(f"{place}: expected paths below the sequence; found {str(name)!r}")
    numbers = {frame_field(name) for name in photographs}
    if len(numbers) != 1:
        raise InputError(f"{place}: expected one frame number for all cameras; found {sorted(numbers)[:3]}")
    return photographs


def frame_number(name: PurePath) -> int:
    """Frame number in the name of an image, by which files of bodies are named.

    Raises:
        InputError: the name has no frame number.
    """
    field = frame_field(name)
    if not field.isdecimal():
        raise InputError(
            f"{name}: expected a frame number, or a name whose fifth field is one; found {name.name!r}"
        )
    return int(field)


def frame_field(name: PurePath) -> str:
    """Frame number as written in the name of an image: ``000012``, or ``0001`` in
    ``…_Camera_(1)_0001_2019-…``."""
    fields = name.stem.split("_")
    return fields[4] if len(fields) > 4 else name.stem


class ZJUMoCapReader(FrameReader):
    """Reader of ZJU-MoCap frames, selected by their indices in ``annots.npy``."""

    calibration = "annots.npy"

    def __init__(self, data: "ZJUMoCap", phase: str) -> None:
        sequences = []
        for some in getattr(data.split, phase):
            sequences += [(f"CoreView_{name}", range(*some.frames)) for name in some.sequences]
        super().__init__(data.folder, phase, sequences, sequences[0][0])

    def frames_of(self, folder: Path, wanted: range) -> list[Frame]:
        path = folder / self.calibration
        cameras, photographs = read_annotations(path)
        if len(cameras) < CAMERAS:
            raise InputError(f"{path}: expected {CAMERAS} cameras; found {len(cameras)}")
        chosen = [names for index, names in enumerate(photographs) if index in wanted]
        if not chosen:
            raise InputError(f"{path}: expected a frame {wanted.start}; found {len(photographs)} frames")
        positions = tuple(range(CAMERAS))
        return [Frame(folder, frame_number(folder / names[0]), cameras, positions, names) for names in chosen]

    def photograph(self, frame: Frame, position: int) -> Path:
        photograph = frame.photographs[position]
        return _find(frame.folder, photograph, photograph.suffix)

    def mask(self, frame: Frame, position: int) -> Path:
        return _find(frame.folder / _MASKS, frame.photographs[position], ".png")

    def body_place(self, name: str) -> Path:
        frame = self.frames[name]
        folders = [frame.folder / kind for kind in _BODIES]
        folder = next((path for path in folders if path.is_dir()), folders[0])
        return folder / f"{frame.number}.npy"

    def read_body(self, name: str) -> np.ndarray | None:
        path = self.body_place(name)
        return read_array(path, [(BODY_VERTICES, 3)]).astype(np.float32) if path.exists() else None


def _find(folder: Path, photograph: PurePosixPath, suffix: str) -> Path:
    """Path of an image, under its name or only its frame field (renamed files of 313 and 315)."""
    usual = photograph.with_suffix(suffix)
    renamed = usual.with_name(frame_field(photograph) + suffix)
    return find_path(folder, str(usual)) or find_path(folder, str(renamed)) or folder / usual


class Frames(Options):
    """A range of frames in several sequences."""

    sequences: tuple[Annotated[Text | Index, AfterValidator(str)], ...] = Field(min_length=1)
    """Ids, such as 377."""
    frames: tuple[Index, Index, Count]
    """[start, stop, step] of the indices in annots.npy, from 0. Frames beyond the end of a sequence are
    skipped, as in the published loaders."""

    @model_validator(mode="after")
    def _check(self) -> "Frames":
        self.require(self.frames[0] < self.frames[1], "frames", "[start, stop, step] with start < stop")
        return self


class FramesByPhase(Options):
    """Frames of each phase."""

    train: tuple[Frames, ...] = Field(min_length=1)
    """Sequences and their frames."""
    val: tuple[Frames, ...] = Field(min_length=1)
    """Sequences and their frames."""


class ZJUMoCap(DataSet):
    """Downloaded ZJU-MoCap sequences below ``root``; each frame of a sequence is a subject."""

    static_cameras: ClassVar[bool] = True
    ring: ClassVar[int] = CAMERAS

    name: Text = "zju_mocap"
    size: Size = 512
    split: FramesByPhase
    """Sequences and frames of each phase."""

    def reader(self, phase: str) -> ZJUMoCapReader:
        return ZJUMoCapReader(self, phase)
