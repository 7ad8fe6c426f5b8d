"""ZJU-MoCap as it is configured."""

from collections.abc import Mapping
from typing import Annotated, ClassVar

from pydantic import Field, model_validator

from ghgs_lit.config.options import Options, Size, Text, Workers
from ghgs_lit.data.dataset import DataSet
from ghgs_lit.data.zju_mocap.reader import Frames, ZJUMoCapReader

# Cameras of a sequence where all are used and nothing else is known; some have 23.
_ALL = 21


class FramesByPhase(Options):
    """Which frames are train and val."""

    train: tuple[Frames, ...]
    """Sequences and their frames."""
    val: tuple[Frames, ...]
    """Sequences and their frames."""

    @model_validator(mode="after")
    def _check(self) -> "FramesByPhase":
        for phase in ("train", "val"):
            self.require(self.of(phase) != (), phase, "sequences and frames")
        return self

    def of(self, phase: str) -> tuple[Frames, ...]:
        """The frames of a phase."""
        return getattr(self, phase)


class ZJUMoCap(DataSet):
    """Downloaded ZJU-MoCap sequences below ``root``; a sample is one frame of one sequence."""

    published: ClassVar[Mapping[str, int]] = {"train": 6, "val": 3}
    static_cameras: ClassVar[bool] = True

    name: Text = "zju_mocap"
    size: Size = (512, 512)
    workers: Workers = 8
    split: FramesByPhase
    """Sequences of each phase, and which of their frames."""
    cameras: Annotated[int, Field(ge=2)] | None = 20
    """Cameras used of each sequence, the first ones, which make up the ring; null: all, a ring of 21."""
    undistorted: bool = True
    """Remove the lens distortion of photographs and masks (SHERF does not, most others do)."""
    masks: tuple[Text, ...] = Field(("mask_cihp",), min_length=1)
    """Folders of label maps; those that a sequence has are united."""

    @property
    def ring(self) -> int:
        return self.cameras or _ALL

    def reader(self, phase: str, strict: bool = True) -> ZJUMoCapReader:
        frames, limit = self.split.of(phase), self.limit.of(phase)
        return ZJUMoCapReader(self.folder, frames, self.cameras, self.undistorted, self.masks, limit, strict)
