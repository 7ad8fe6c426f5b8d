"""ZJU-MoCap as it is configured."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

from ghgs_lit.config.settings import from_config, set_fields
from ghgs_lit.data.dataset import DataSet
from ghgs_lit.data.reader import PHASES
from ghgs_lit.data.zju_mocap.reader import Split, ZJUMoCapReader
from ghgs_lit.errors import choice, require


@dataclass(frozen=True, kw_only=True)
class ZJUMoCap(DataSet):
    """Downloaded ZJU-MoCap sequences below ``root``; a sample is one frame of one sequence.

    Attributes:
        splits: for ``train`` and ``val`` a list of :class:`Split` or their mappings.
        cameras, undistorted, masks, bodies: as for :class:`ZJUMoCapReader`.
    """

    published: ClassVar[Mapping[str, int]] = {"train": 6, "val": 3}
    static_cameras: ClassVar[bool] = True

    splits: Mapping[str, Sequence[Split | Mapping[str, Any]]]
    cameras: int | None = 20
    undistorted: bool = True
    masks: Sequence[str] = ("mask_cihp",)
    bodies: Sequence[str] = ("new_vertices", "vertices")

    def __post_init__(self) -> None:
        super().__post_init__()
        splits = {}
        for phase in self.splits:
            choice("data.splits key", phase, PHASES)
        for phase in PHASES:
            key, listed = f"data.splits.{phase}", self.splits.get(phase)
            require(bool(listed), key, "sequences and frames", listed)
            splits[phase] = [from_config(Split, key, split) for split in listed]
        require(self.cameras is None or self.cameras >= 2, "data.cameras", "at least 2 or null", self.cameras)
        require(len(self.masks) > 0, "data.masks", "folders of masks", list(self.masks))
        set_fields(self, splits=splits)

    def reader(self, phase: str, strict: bool = True) -> ZJUMoCapReader:
        splits, limit = self.splits[phase], self.limit[phase]
        return ZJUMoCapReader(
            self.folder, splits, self.cameras, self.undistorted, self.masks, self.bodies, limit, strict
        )
