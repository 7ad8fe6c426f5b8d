"""ZJU-MoCap for Lightning."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

from ghgs_lit.config.settings import from_config
from ghgs_lit.data.datamodule import PHASES, PhotographsDataModule
from ghgs_lit.data.reader import Reader
from ghgs_lit.data.zju_mocap.reader import Split, ZJUMoCapReader
from ghgs_lit.errors import choice, require


class ZJUMoCapDataModule(PhotographsDataModule):
    """Downloaded ZJU-MoCap sequences below ``root``; a sample is one frame of one sequence.

    Args:
        splits: for ``train`` and ``val`` a list of :class:`Split` or their mappings.
        cameras, undistorted, masks, bodies: as for :class:`ZJUMoCapReader`.
        others: as for :class:`PhotographsDataModule`.
    """

    still = True
    published: ClassVar[Mapping[str, int]] = {"train": 6, "val": 3}

    def __init__(
        self,
        splits: Mapping[str, Sequence[Split | Mapping[str, Any]]],
        cameras: int | None = 20,
        undistorted: bool = True,
        masks: Sequence[str] = ("mask_cihp",),
        bodies: Sequence[str] = ("new_vertices", "vertices"),
        **others: Any,
    ) -> None:
        super().__init__(**others)
        for phase in splits:
            choice("data.splits key", phase, PHASES)
        for phase in PHASES:
            require(
                bool(splits.get(phase)), f"data.splits.{phase}", "sequences and frames", splits.get(phase)
            )
        self.splits = {
            phase: [from_config(Split, f"data.splits.{phase}", split) for split in splits[phase]]
            for phase in PHASES
        }
        require(cameras is None or cameras >= 2, "data.cameras", "at least 2 or null", cameras)
        require(len(masks) > 0, "data.masks", "folders of masks", list(masks))
        self._options = {"cameras": cameras, "undistorted": undistorted, "masks": masks, "bodies": bodies}

    def reader(self, phase: str, size: tuple[int, int] | None, strict: bool = True) -> ZJUMoCapReader:
        return ZJUMoCapReader(
            self.folder,
            self.splits[phase],
            limit=self.limit[phase],
            size=size,
            cache_mb=self.cache_images_mb,
            strict=strict,
            **self._options,
        )

    def people(self, reader: Reader) -> int:
        return len(reader.sequences)

    def miniature(self, people: Mapping[str, int], size: int, seed: int) -> list[Path]:
        from ghgs_lit.synthesis.miniatures.zju_mocap import make

        sequences = {
            phase: [s for split in splits for s in split.sequences] for phase, splits in self.splits.items()
        }
        require(self.root is not None, "data.root", "a folder to write to", None)
        chosen = [s for phase, listed in sequences.items() for s in listed[: people[phase]]]
        return make(Path(self.root).expanduser(), chosen, size, seed)
