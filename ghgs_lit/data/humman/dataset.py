"""Options and reader of HuMMan-Recon v1.0.

``<root>/p<subject>_a<action>/`` holds, for the Kinects 000 to 009 and frames that are multiples of 6 (some
are missing), ``kinect_color/kinect_<k>/<frame>.png`` (1920 x 1080), ``kinect_mask/`` with the same names
(matting: any value but 0 is the performer), for the test sequences ``kinect_mask_manual/``, ``kinect_depth/``
(640 x 576, millimetres, frame of the depth camera), ``smpl_params/<frame>.npz`` and ``cameras.json``.
"""

import logging
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np
from pydantic import model_validator

from ghgs_lit.config import options
from ghgs_lit.config.options import Count, Index, Options, Size, Text, Workers
from ghgs_lit.data.dataset import DataSet
from ghgs_lit.data.decoding import check_center, check_name, read_image, read_map, read_photograph
from ghgs_lit.data.humman.cameras import KINECTS, Calibration, read_calibration, surface_points
from ghgs_lit.data.humman.smpl import Body, read_parameters
from ghgs_lit.data.reader import PHASES, FrameReader
from ghgs_lit.data.view import View, opencv_view
from ghgs_lit.errors import InputError

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class _Frame:
    folder: Path
    cameras: Calibration
    number: int


class HuMManReader(FrameReader):
    """Frames of the sequences of a phase, each a subject ``<sequence>_<frame>``; positions are the colour
    cameras. Missing sequences, frames and cameras of a frame are left out. InputError: all sequences are
    missing, cameras are bad, or the body model cannot be loaded."""

    def __init__(self, data: "HuMMan", phase: str, strict: bool = True) -> None:
        super().__init__(strict)
        self.data, folder, names = data, data.folder, data.sequences(phase)
        self._body: Body | None = None
        if data.body == "smpl":
            with self.collecting():
                self._body = _load_model(data.smpl_model)
        for name in self.existing(folder, names, "p000455_a000986"):
            with self.collecting():
                self._add(folder / name, range(*data.frames))
        self.subjects = dict(list(self.subjects.items())[: data.limit.of(phase)])

    def _add(self, path: Path, frames: Sequence[int]) -> None:
        cameras = read_calibration(path / "cameras.json", "color")
        there = {k: _frames_of(path / "kinect_color" / f"kinect_{k:03d}") for k in KINECTS}
        # Existing frames are listed, because any number may be asked for.
        numbers = [number for number in sorted(set().union(*there.values())) if number in frames]
        found = {number: tuple(k for k in KINECTS if number in there[k]) for number in numbers}
        if not found:
            raise InputError(
                f"{path / 'kinect_color'}: expected frames such as {frames[0]:06d}.png; found none of "
                f"{len(frames)} (frame numbers are multiples of 6)"
            )
        if len(found) < len(frames):
            log.info("%s: %d of %d frames are there", path, len(found), len(frames))
        for number, positions in found.items():
            if len(positions) < len(KINECTS):
                lacking = sorted(set(KINECTS) - set(positions))
                log.warning("%s: frame %06d lacks kinects %s, left out", path, number, lacking)
            name = check_name(f"{path.name}_{number:06d}")
            self.frames[name] = _Frame(path, cameras, number)
            self.subjects[name] = positions

    def read_view(self, name: str, position: int, view: int, depth: bool) -> View:
        frame = self.frames[name]
        path = _file(frame.folder, "kinect_color", position, frame.number)
        image = read_photograph(path)
        mask = self._mask(frame, position, image.shape[:2])
        intrinsics = frame.cameras.intrinsics[position]
        check_center(path, intrinsics, *image.shape[:2])
        return opencv_view(image, mask, intrinsics, frame.cameras.extrinsics[position])

    def read_body(self, name: str) -> np.ndarray | None:
        frame = self.frames[name]
        if self.data.body == "depth":
            masks = {position: self._mask(frame, position) for position in self.subjects[name]}
            depth_cameras = read_calibration(frame.folder / "cameras.json", "depth")
            return surface_points(frame.folder, frame.number, depth_cameras, frame.cameras, masks)
        if self._body is None:
            return None
        return self._body.vertices(read_parameters(frame.folder / "smpl_params" / f"{frame.number:06d}.npz"))

    def place(self, name: str, position: int, view: int) -> str:
        frame = self.frames[name]
        return str(_file(frame.folder, self.data.masks, position, frame.number))

    def _mask(self, frame: _Frame, position: int, size: tuple[int, int] | None = None) -> np.ndarray:
        path = _file(frame.folder, self.data.masks, position, frame.number)
        if size is None:
            image = read_image(path)
            size = (image.height, image.width)
        return read_map(path, size) != 0


def _load_model(path: str | None) -> Body:
    if path is None:
        raise InputError(
            "data.smpl_model: expected the licensed SMPL_NEUTRAL.pkl for body=smpl; found null "
            "(body=depth takes points of the depth cameras in its place; body=none with "
            "loss.weights.chamfer=0 trains without)"
        )
    return Body(Path(path).expanduser())


def _file(folder: Path, kind: str, kinect: int, number: int) -> Path:
    return folder / kind / f"kinect_{kinect:03d}" / f"{number:06d}.png"


def _frames_of(folder: Path) -> set[int]:
    if not folder.is_dir():
        return set()
    return {int(p.stem) for p in folder.iterdir() if p.suffix == ".png" and p.stem.isdecimal()}


_SEQUENCE = re.compile(r"p\d{6}_a\d{6}")
# Largest difference of the first camera's pose from the identity.
_POSE_TOLERANCE = 1e-2


class SequenceNames(Options):
    """Sequences of each phase."""

    train: tuple[Text, ...] | None = None
    """Names of sequences; null: all that exist but those of val."""
    val: tuple[Text, ...]
    """Names of sequences."""

    @model_validator(mode="after")
    def _check(self) -> "SequenceNames":
        self.require(self.val != (), "val", "names of sequences")
        return self

    def of(self, phase: str) -> tuple[str, ...] | None:
        """Names of a phase."""
        return getattr(self, phase)


class HuMMan(DataSet):
    """Downloaded HuMMan-Recon sequences below ``root``; a subject is one frame of one sequence."""

    published: ClassVar[Mapping[str, int]] = {"train": 317, "val": 22}
    static_cameras: ClassVar[bool] = True
    ring: ClassVar[int] = len(KINECTS)

    name: Text = "humman"
    size: Size = (360, 640)
    workers: Workers = 8
    split: SequenceNames
    """Sequences of each phase."""
    frames: tuple[Index, Index, Count] = (0, 97, 6)
    """[start, stop, step] of frame numbers; those that a sequence lacks are left out."""
    masks: Literal["kinect_mask", "kinect_mask_manual"] = "kinect_mask"
    """Folder of masks; kinect_mask_manual is there for the test sequences only."""
    body: Literal["smpl", "depth", "none"] = "smpl"
    """smpl: vertices of the licensed model. depth: points of the depth cameras instead. none: train with
    loss.weights.chamfer=0."""
    smpl_model: options.Path | None = None
    """SMPL_NEUTRAL.pkl, or a folder with smpl/SMPL_NEUTRAL.pkl; needs the package smplx."""

    @model_validator(mode="after")
    def _check(self) -> "HuMMan":
        self.require(self.frames[0] < self.frames[1], "frames", "[start, stop, step] with start < stop")
        return self

    def sequences(self, phase: str) -> list[str]:
        """Names of the sequences of a phase; listed ones need not exist."""
        if (names := self.split.of(phase)) is not None:
            return list(names)
        names = (p.name for p in self.folder.iterdir() if p.is_dir() and _SEQUENCE.fullmatch(p.name))
        return sorted(set(names) - set(self.split.val))

    def has(self, phase: str) -> bool:
        return len(self.sequences(phase)) > 0

    def reader(self, phase: str, strict: bool = True) -> HuMManReader:
        return HuMManReader(self, phase, strict)

    def inspections(self) -> Sequence[Callable[[], None]]:
        names = {name for phase in PHASES for name in self.sequences(phase)} if self.root else set()
        there = [path for name in sorted(names) if (path := self.folder / name).is_dir()]
        return [partial(check_world, path / "cameras.json") for path in there]


def check_world(path: Path) -> None:
    """Check a ``cameras.json``. InputError: it is bad, or its world is not the first colour camera's."""
    first = read_calibration(path, "color").extrinsics[0]
    if np.abs(first - np.eye(4)).max() > _POSE_TOLERANCE:
        raise InputError(
            f"{path}: expected the world in the frame of kinect_color_000 (R = 1, T = 0); "
            f"found T = {first[:3, 3].round(3).tolist()}"
        )
