"""HuMMan-Recon v1.0 as it is configured."""

import re
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np
from pydantic import model_validator

from ghgs_lit.config import options
from ghgs_lit.config.options import Count, Index, Options, Size, Text, Workers
from ghgs_lit.data.dataset import DataSet
from ghgs_lit.data.humman.cameras import KINECTS, read_calibration
from ghgs_lit.data.humman.reader import HuMManReader
from ghgs_lit.data.reader import PHASES
from ghgs_lit.errors import InputError

_SEQUENCE = re.compile(r"p\d{6}_a\d{6}")
# How far the first camera's pose may differ from the identity.
_POSE_TOLERANCE = 1e-2


class SequenceNames(Options):
    """Which sequences are train and val."""

    train: tuple[Text, ...] | None = None
    """Names of sequences; null: all that exist but those of val."""
    val: tuple[Text, ...]
    """Names of sequences."""

    @model_validator(mode="after")
    def _check(self) -> "SequenceNames":
        self.require(self.val != (), "val", "names of sequences")
        return self

    def of(self, phase: str) -> tuple[str, ...] | None:
        """The names of a phase."""
        return getattr(self, phase)


class HuMMan(DataSet):
    """Downloaded HuMMan-Recon sequences below ``root``; a sample is one frame of one sequence."""

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
        """Names of the sequences of a phase, whether they exist or not."""
        if (names := self.split.of(phase)) is not None:
            return list(names)
        names = (p.name for p in self.folder.iterdir() if p.is_dir() and _SEQUENCE.fullmatch(p.name))
        return sorted(set(names) - set(self.split.val))

    def has(self, phase: str) -> bool:
        return len(self.sequences(phase)) > 0

    def reader(self, phase: str, strict: bool = True) -> HuMManReader:
        names, limit = self.sequences(phase), self.limit.of(phase)
        model = None if self.smpl_model is None else Path(self.smpl_model).expanduser()
        return HuMManReader(
            self.folder, names, range(*self.frames), self.masks, self.body, model, limit, strict
        )

    def inspections(self) -> Sequence[Callable[[], None]]:
        names = {name for phase in PHASES for name in self.sequences(phase)} if self.root else set()
        there = [path for name in sorted(names) if (path := self.folder / name).is_dir()]
        return [partial(check_world, path / "cameras.json") for path in there]


def check_world(path: Path) -> None:
    """Check that the world of a ``cameras.json`` is the frame of its first colour camera. InputError: it is
    not, or the file is bad."""
    first = read_calibration(path, "color").extrinsics[0]
    if np.abs(first - np.eye(4)).max() > _POSE_TOLERANCE:
        raise InputError(
            f"{path}: expected the world in the frame of kinect_color_000 (R = 1, T = 0); "
            f"found T = {first[:3, 3].round(3).tolist()}"
        )
