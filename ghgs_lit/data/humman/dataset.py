"""HuMMan-Recon v1.0 as it is configured."""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import ClassVar

import numpy as np

from ghgs_lit.config.settings import set_fields
from ghgs_lit.data.dataset import DataSet
from ghgs_lit.data.humman.cameras import read_calibration
from ghgs_lit.data.humman.reader import BODIES, HuMManReader
from ghgs_lit.data.reader import PHASES
from ghgs_lit.errors import InputError, choice, require

_SEQUENCE = re.compile(r"p\d{6}_a\d{6}")
# How far the first camera's pose may differ from the identity.
_POSE_TOLERANCE = 1e-2


@dataclass(frozen=True, kw_only=True)
class HuMMan(DataSet):
    """Downloaded HuMMan-Recon sequences below ``root``; a sample is one frame of one sequence.

    Attributes:
        split: names of the sequences of ``val`` and of ``train`` (null: all others that exist).
        frames: [start, stop, step] of the frame numbers.
        masks, body, smpl_model: as for :class:`HuMManReader`.
    """

    published: ClassVar[Mapping[str, int]] = {"train": 317, "val": 22}
    static_cameras: ClassVar[bool] = True

    split: Mapping[str, Sequence[str] | None]
    frames: Sequence[int] = (0, 97, 6)
    masks: str = "kinect_mask"
    body: str = "smpl"
    smpl_model: str | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        for phase in self.split:
            choice("data.split key", phase, PHASES)
        val, frames = self.split.get("val"), self.frames
        require(bool(val), "data.split.val", "names of sequences", val)
        valid = len(frames) == 3 and 0 <= frames[0] < frames[1] and frames[2] >= 1
        require(valid, "data.frames", "[start, stop, step] with start < stop", list(frames))
        choice("data.masks", self.masks, ("kinect_mask", "kinect_mask_manual"))
        choice("data.body", self.body, BODIES)
        set_fields(self, split=dict.fromkeys(PHASES) | dict(self.split), frames=tuple(frames))

    def sequences(self, phase: str) -> list[str]:
        """Names of the sequences of a phase, whether they exist or not."""
        if self.split[phase] is not None:
            return list(self.split[phase])
        names = (p.name for p in self.folder.iterdir() if p.is_dir() and _SEQUENCE.fullmatch(p.name))
        return sorted(set(names) - set(self.split["val"]))

    def has(self, phase: str) -> bool:
        return len(self.sequences(phase)) > 0

    def reader(self, phase: str, strict: bool = True) -> HuMManReader:
        names, limit = self.sequences(phase), self.limit[phase]
        model = None if self.smpl_model is None else Path(self.smpl_model).expanduser()
        return HuMManReader(
            self.folder, names, range(*self.frames), self.masks, self.body, model, limit, strict
        )

    def inspections(self) -> Sequence[Callable[[], None]]:
        names = {name for phase in PHASES for name in self.sequences(phase)} if self.root else set()
        there = [path for name in sorted(names) if (path := self.folder / name).is_dir()]
        return [partial(check_world, path / "cameras.json") for path in there]


def check_world(path: Path) -> None:
    """Check that the world of a ``cameras.json`` is the frame of its first colour camera.

    Raises:
        InputError: it is not, or the file is bad.
    """
    first = read_calibration(path, "color").extrinsics[0]
    if np.abs(first - np.eye(4)).max() > _POSE_TOLERANCE:
        raise InputError(
            f"{path}: expected the world in the frame of kinect_color_000 (R = 1, T = 0); "
            f"found T = {first[:3, 3].round(3).tolist()}"
        )
