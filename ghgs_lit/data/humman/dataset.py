"""Options and reader of HuMMan-Recon v1.0.

``<root>/p<subject>_a<action>/`` holds, for the Kinects 000 to 009 and frames that are multiples of
6 (some are missing), ``kinect_color/kinect_<k>/<frame>.png`` (1920 x 1080), ``kinect_mask/`` with
the same names (matting: any value but 0 is the performer), for the test sequences
``kinect_mask_manual/``, ``smpl_params/<frame>.npz`` and ``cameras.json``: ``K`` (3, 3), ``R``
(3, 3) and ``T`` (3) of each ``kinect_color_<k>`` as in OpenCV, world to camera in metres, without
lens distortion.
"""

import logging
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
from pydantic import Field, model_validator

from ghgs_lit.config import options
from ghgs_lit.config.options import Count, Index, Options, Size, Text
from ghgs_lit.data.dataset import DataSet
from ghgs_lit.data.decoding import (
    check_array,
    check_center,
    check_extrinsics,
    check_intrinsics,
    check_name,
    read_map,
    read_photograph,
)
from ghgs_lit.data.humman.smpl import Body, read_parameters
from ghgs_lit.data.reader import FrameReader
from ghgs_lit.data.view import View, opencv_view
from ghgs_lit.errors import InputError
from ghgs_lit.parsing import find_path, read_json

log = logging.getLogger(__name__)

KINECTS = range(10)
# Metres: least and greatest plausible distance between cameras of one studio.
_NEAREST = 0.1
_FURTHEST = 100.0
_SEQUENCE = re.compile(r"p\d{6}_a\d{6}")

#: Intrinsics [3, 3] with pixel centres at integers, and extrinsics [4, 4].
Camera = tuple[np.ndarray, np.ndarray]


def read_cameras(path: Path) -> list[Camera]:
    """Read the ten colour cameras of a sequence.

    Args:
        path: of ``cameras.json``.

    Returns:
        Intrinsics [3, 3] in pixels, with centres at integers, and extrinsics [4, 4] in metres
        of each camera.

    Raises:
        InputError: the file or a camera is missing or bad, or translations are not in metres.
    """
    content = read_json(path, "the cameras of a sequence in JSON")
    cameras = [_camera(path, content, f"kinect_color_{k:03d}") for k in KINECTS]
    centers = np.stack([-pose[:3, :3].T @ pose[:3, 3] for _, pose in cameras])
    spread = np.linalg.norm(centers - centers[0], axis=-1).max()
    if not _NEAREST < spread < _FURTHEST:
        raise InputError(f"{path}: expected translations T in metres; found cameras {spread:.4g} m apart")
    return cameras


def _camera(path: Path, content: Any, key: str) -> Camera:
    camera = content.get(key) if isinstance(content, dict) else None
    for name in ("K", "R", "T"):
        if not isinstance(camera, dict) or name not in camera:
            raise InputError(f"{path}: expected {name} of {key}; found none")
    place = f"{path}: {key}"
    rotation = check_array(f"{place}: R", camera["R"], [(3, 3)])
    translation = check_array(f"{place}: T", camera["T"], [(3,), (3, 1)]).reshape(3, 1)
    extrinsics = check_extrinsics(place, np.concatenate((rotation, translation), 1))
    return check_intrinsics(f"{place}: K", camera["K"]), extrinsics


@dataclass(frozen=True)
class _Frame:
    folder: Path
    cameras: Sequence[Camera]
    number: int

    def file(self, kind: str, kinect: int) -> Path:
        folder = self.folder / kind / f"kinect_{kinect:03d}"
        name = f"{self.number:06d}.png"
        return find_path(folder, name) or folder / name

    @property
    def parameters(self) -> Path:
        """File of the body's parameters."""
        return self.folder / "smpl_params" / f"{self.number:06d}.npz"


class HuMManReader(FrameReader):
    """Frames of the sequences of a phase, each a subject ``<sequence>_<frame>``; positions are the
    colour cameras.

    Missing sequences, frames and cameras of a frame are left out.

    Args:
        data: options of the data set.
        phase: ``train`` or ``val``.
        strict: raise the first problem of the data, or collect all.

    Raises:
        InputError: all sequences are missing, cameras are bad, or the body model cannot be loaded.
    """

    def __init__(self, data: "HuMMan", phase: str, strict: bool = True) -> None:
        super().__init__(strict)
        self.data = data
        folder = data.folder
        names = data.sequences(phase)
        self._body: Body | None = None
        if data.smpl_model is not None:
            with self.collecting():
                self._body = Body(Path(data.smpl_model).expanduser())
        for name in self.existing(folder, names, phase, "p000455_a000986"):
            with self.collecting():
                self._add(folder / name, range(*data.frames))
        self.subjects = dict(list(self.subjects.items())[: data.limit.of(phase)])

    def _add(self, path: Path, frames: Sequence[int]) -> None:
        """Add the frames of a sequence as subjects.

        Args:
            path: folder of the sequence.
            frames: numbers of frames that are wanted; those that are not there are left out.

        Raises:
            InputError: cameras are bad, or no frame is there.
        """
        cameras = read_cameras(path / "cameras.json")
        there = {k: _frames_of(path / "kinect_color" / f"kinect_{k:03d}") for k in KINECTS}
        # Existing frames are listed, because any number may be asked for.
        numbers = [number for number in sorted(set().union(*there.values())) if number in frames]
        positions_of = {}
        for number in numbers:
            positions_of[number] = tuple(k for k in KINECTS if number in there[k])
        if not positions_of:
            raise InputError(
                f"{path / 'kinect_color'}: expected frames such as {frames[0]:06d}.png; found none "
                f"of {len(frames)} (frame numbers are multiples of 6)"
            )
        if len(positions_of) < len(frames):
            log.info("%s: %d of %d frames are there", path, len(positions_of), len(frames))
        for number, positions in positions_of.items():
            if len(positions) < len(KINECTS):
                lacking = sorted(set(KINECTS) - set(positions))
                log.warning("%s: frame %06d lacks kinects %s, left out", path, number, lacking)
            name = check_name(f"{path.name}_{number:06d}")
            self.frames[name] = _Frame(path, cameras, number)
            self.subjects[name] = positions

    def read_view(self, name: str, position: int, view: int, depth: bool) -> View:
        """See :meth:`Reader.read_view`.

        Args:
            name: of the subject, ``<sequence>_<frame>``.
            position: number of the Kinect, 0 to 9.
            view: not used; there are no views between cameras.
            depth: not used; no depth maps are read.
        """
        frame = self.frames[name]
        path = frame.file("kinect_color", position)
        image = read_photograph(path)
        mask = read_map(frame.file(self.data.masks, position), image.shape[:2]) != 0
        intrinsics, extrinsics = frame.cameras[position]
        check_center(path, intrinsics, *image.shape[:2])
        return opencv_view(image, mask, intrinsics, extrinsics)

    def read_body(self, name: str) -> np.ndarray | None:
        if self._body is None:
            return None
        return self._body.vertices(read_parameters(self.frames[name].parameters))

    def sources(self, name: str) -> Iterator[Path | str]:
        frame = self.frames[name]
        yield frame.folder / "cameras.json"
        for position in self.subjects[name]:
            yield frame.file("kinect_color", position)
            yield frame.file(self.data.masks, position)
        if self._body is not None:
            yield frame.parameters
            yield self._body.file

    def body_place(self, name: str) -> Path | str:
        return "data.smpl_model" if self._body is None else self.frames[name].parameters

    def place(self, name: str, position: int, view: int) -> str:
        return str(self.frames[name].file(self.data.masks, position))


def _frames_of(folder: Path) -> set[int]:
    if not folder.is_dir():
        return set()
    return {int(p.stem) for p in folder.iterdir() if p.suffix.lower() == ".png" and p.stem.isdecimal()}


class SequenceNames(Options):
    """Sequences of each phase."""

    train: tuple[Text, ...] | None = None
    """Names of sequences; null: all that exist but those of val."""
    val: tuple[Text, ...] = Field(min_length=1)
    """Names of sequences."""


class HuMMan(DataSet):
    """Downloaded HuMMan-Recon sequences below ``root``; a subject is one frame of one sequence."""

    published: ClassVar[Mapping[str, int]] = {"train": 317, "val": 22}
    static_cameras: ClassVar[bool] = True
    ring: ClassVar[int] = len(KINECTS)

    name: Text = "humman"
    size: Size = (360, 640)
    split: SequenceNames
    """Sequences of each phase."""
    frames: tuple[Index, Index, Count] = (0, 97, 6)
    """[start, stop, step] of frame numbers; those that a sequence lacks are left out."""
    masks: Literal["kinect_mask", "kinect_mask_manual"] = "kinect_mask"
    """Folder of masks; kinect_mask_manual is there for the test sequences only."""
    smpl_model: options.PathText | None = None
    """The licensed SMPL_NEUTRAL.pkl, or a folder with smpl/SMPL_NEUTRAL.pkl: its vertices are the
    bodies. It needs the package smplx. Null: no bodies; train with loss.weights.chamfer=0."""

    @model_validator(mode="after")
    def _check(self) -> "HuMMan":
        self.require(self.frames[0] < self.frames[1], "frames", "[start, stop, step] with start < stop")
        return self

    def sequences(self, phase: str) -> list[str]:
        """Names of the sequences of a phase; listed ones need not exist."""
        if (names := getattr(self.split, phase)) is not None:
            return list(names)
        names = (p.name for p in self.folder.iterdir() if p.is_dir() and _SEQUENCE.fullmatch(p.name))
        return sorted(set(names) - set(self.split.val))

    def has(self, phase: str) -> bool:
        return len(self.sequences(phase)) > 0

    def reader(self, phase: str, strict: bool = True) -> HuMManReader:
        return HuMManReader(self, phase, strict)
