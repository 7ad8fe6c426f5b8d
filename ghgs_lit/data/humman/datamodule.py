"""HuMMan-Recon v1.0 for Lightning."""

import re
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from ghgs_lit.data.datamodule import PHASES, PhotographsDataModule
from ghgs_lit.data.humman.cameras import read_calibration
from ghgs_lit.data.humman.reader import BODIES, HuMManReader
from ghgs_lit.data.reader import Reader
from ghgs_lit.errors import InputError, choice, require

_SEQUENCE = re.compile(r"p\d{6}_a\d{6}")
# What of the first camera's pose may differ from none at all.
_NO_POSE = 1e-2


class HuMManDataModule(PhotographsDataModule):
    """Downloaded HuMMan-Recon sequences below ``root``; a sample is one frame of one sequence.

    Args:
        split: names of the sequences of ``val`` and of ``train`` (null: all others that are there).
        frames: [start, stop, step] of the frame numbers.
        masks, body, smpl_model: as for :class:`HuMManReader`.
        others: as for :class:`PhotographsDataModule`.
    """

    still = True
    published: ClassVar[Mapping[str, int]] = {"train": 317, "val": 22}

    def __init__(
        self,
        split: Mapping[str, Sequence[str] | None],
        frames: Sequence[int] = (0, 97, 6),
        masks: str = "kinect_mask",
        body: str = "smpl",
        smpl_model: str | None = None,
        **others: Any,
    ) -> None:
        super().__init__(**others)
        for phase in split:
            choice("data.split key", phase, PHASES)
        require(bool(split.get("val")), "data.split.val", "names of sequences", split.get("val"))
        self.split = {phase: split.get(phase) for phase in PHASES}
        valid = len(frames) == 3 and 0 <= frames[0] < frames[1] and frames[2] >= 1
        require(valid, "data.frames", "[start, stop, step] with start < stop", list(frames))
        choice("data.masks", masks, ("kinect_mask", "kinect_mask_manual"))
        choice("data.body", body, BODIES)
        self.frames, self.masks, self.body, self.smpl_model = range(*frames), masks, body, smpl_model

    def sequences(self, phase: str) -> list[str]:
        """Names of a phase's sequences, whether they are there or not."""
        if self.split[phase] is not None:
            return list(self.split[phase])
        names = (p.name for p in self.folder.iterdir() if p.is_dir() and _SEQUENCE.fullmatch(p.name))
        return sorted(set(names) - set(self.split["val"]))

    def reader(self, phase: str, size: tuple[int, int] | None, strict: bool = True) -> HuMManReader:
        return HuMManReader(
            self.folder,
            self.sequences(phase),
            self.frames,
            masks=self.masks,
            body=self.body,
            smpl_model=None if self.smpl_model is None else Path(self.smpl_model).expanduser(),
            limit=self.limit[phase],
            size=size,
            cache_mb=self.cache_images_mb,
            strict=strict,
        )

    def people(self, reader: Reader) -> int:
        return len(reader.sequences)

    def inspections(self) -> Sequence[Callable[[], None]]:
        names = {name for phase in PHASES for name in self.sequences(phase)} if self.root else set()
        there = [path for name in sorted(names) if (path := self.folder / name).is_dir()]
        return [partial(check_world, path / "cameras.json") for path in there]

    def miniature(self, people: Mapping[str, int], size: int, seed: int) -> list[Path]:
        from ghgs_lit.synthesis.miniatures.humman import make

        require(self.root is not None, "data.root", "a folder to write to", None)
        return make(Path(self.root).expanduser(), self.split["val"], people, size, seed)


def check_world(path: Path) -> None:
    """Refuse a ``cameras.json`` whose world is not the frame of its first colour camera.

    Raises:
        InputError: so, or the file is bad.
    """
    first = read_calibration(path, "color").extrinsics[0]
    if np.abs(first - np.eye(4)).max() > _NO_POSE:
        raise InputError(
            f"{path}: expected the world in the frame of kinect_color_000 (R = 1, T = 0); "
            f"found T = {first[:3, 3].round(3).tolist()}"
        )
