"""Options and reader of HuMMan-Recon v1.0.

``<root>/p<subject>_a<action>/`` contains, for the Kinects 000 to 009 and frames that are multiples of 6
(some are missing)::

    kinect_color/kinect_<k>/<frame>.png   images, 1920 x 1080
    kinect_mask/kinect_<k>/<frame>.png    masks from matting: all values except 0 are the performer
    smpl_params/<frame>.npz               parameters of the SMPL body
    cameras.json                          for each ``kinect_color_<k>`` K (3, 3), R (3, 3) and T (3) as in
                                          OpenCV, world to camera, metres, without lens distortion
"""

import logging
import re
from pathlib import Path, PurePosixPath
from typing import ClassVar

import numpy as np
from pydantic import Field, model_validator

from ghgs_lit.config import options
from ghgs_lit.config.options import Count, Index, Options, Size, Text
from ghgs_lit.data.dataset import DataSet
from ghgs_lit.data.frames import Camera, Frame, FrameReader, check_frames, read_camera, spread
from ghgs_lit.data.smpl import Body, read_parameters
from ghgs_lit.errors import InputError
from ghgs_lit.parsing import find_path, read_json

log = logging.getLogger(__name__)

KINECTS = range(10)
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

    def __init__(self, data: "HuMMan", phase: str, strict: bool = True) -> None:
        sequences = [(name, range(*data.frames)) for name in data.sequences(phase)]
        super().__init__(data, phase, sequences, "p000455_a000986", strict)
        self._body: Body | None = None
        if data.smpl_model is not None:
            with self.collect_problems():
                self._body = Body(Path(data.smpl_model).expanduser())

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

    def masks(self, frame: Frame, position: int) -> list[Path]:
        return [self._file(frame, "kinect_mask", position)]

    def _file(self, frame: Frame, kind: str, position: int) -> Path:
        path = frame.folder / kind / frame.photographs[position]
        return find_path(path.parent, path.name) or path

    def body_files(self, frame: Frame) -> list[Path]:
        if self._body is None:
            return []
        return [frame.folder / "smpl_params" / f"{frame.number:06d}.npz", self._body.file]

    def read_body(self, name: str) -> np.ndarray | None:
        files = self.body_files(self.frames[name])
        return self._body.vertices(read_parameters(files[0])) if files else None

    def body_place(self, name: str) -> Path | str:
        files = self.body_files(self.frames[name])
        return files[0] if files else "data.smpl_model"


class SequenceNames(Options):
    """Sequences of each phase."""

    train: tuple[Text, ...] | None = None
    """Names of sequences; null: all that exist except those of val."""
    val: tuple[Text, ...] = Field(min_length=1)
    """Names of sequences."""


class HuMMan(DataSet):
    """Downloaded HuMMan-Recon sequences below ``root``; each frame of a sequence is a subject."""

    static_cameras: ClassVar[bool] = True
    ring: ClassVar[int] = len(KINECTS)

    name: Text = "humman"
    size: Size = (360, 640)
    split: SequenceNames
    """Sequences of each phase."""
    frames: tuple[Index, Index, Count] = (0, 97, 6)
    """[start, stop, step] of frame numbers; frames that a sequence lacks are skipped."""
    smpl_model: options.PathText | None = None
    """The licensed SMPL_NEUTRAL.pkl, or a folder with smpl/SMPL_NEUTRAL.pkl, whose vertices are the
    bodies; requires the package smplx. Null: no bodies; train with loss.weights.chamfer=0."""

    @model_validator(mode="after")
    def _check(self) -> "HuMMan":
        check_frames(self)
        return self

    def sequences(self, phase: str) -> list[str]:
        """Names of the sequences of a phase; configured ones need not exist."""
        if (names := getattr(self.split, phase)) is not None:
            return list(names)
        names = (p.name for p in self.folder.iterdir() if p.is_dir() and _SEQUENCE.fullmatch(p.name))
        return sorted(set(names) - set(self.split.val))

    def has(self, phase: str) -> bool:
        return len(self.sequences(phase)) > 0

    def reader(self, phase: str, strict: bool = True) -> HuMManReader:
        return HuMManReader(self, phase, strict)
