"""What a section of ``benchmarks/gpu.py`` is called with: its machine, its sizes, the file of findings."""

import json
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch

from benchmarks.gpu_measure import Gpu
from ghgs_lit.config import run_of
from ghgs_lit.config.run import Run
from ghgs_lit.diagnostics.benchmark.scene import ellipsoid_batch
from ghgs_lit.types import Batch


@dataclass(frozen=True)
class Sizes:
    """What is measured, and how often."""

    side: int = 252
    large: int = 518
    views: int = 4
    batches: tuple[int, ...] = (1, 8)
    large_batches: tuple[int, ...] = (1, 2)
    encoder: str = "vggt_1b"
    shipped: tuple[str, ...] = ()  #: further overrides of experiment=shipped
    repeats: int = 15
    copied: int = 2**28  #: numbers of float32
    product: int = 8192  #: rows and columns
    vertices: int = 10475
    workers: tuple[int, ...] = (4, 8, 15)
    seconds: float = 8.0  #: of a measurement of the loader
    people: tuple[tuple[int, int, int], ...] = (
        *((16, 8, 4), (48, 24, 16), (96, 48, 16), (144, 72, 16), (200, 100, 16)),
    )  #: training people, active ones, validation people: each is a step further
    training: tuple[str, ...] = ("trainer.max_time=00:00:03:00", "trainer.val_check_interval=25")


DRY = Sizes(
    side=56,
    large=56,
    views=2,
    batches=(1, 2),
    encoder="vggt_nano",
    shipped=(
        *("data.size=28", "data.render.samples=1", "encoder.width=48", "augmentation=none"),
        "rounds.height=null",  # smaller copies would keep steps from being recorded
    ),
    repeats=1,
    copied=2**10,
    product=64,
    vertices=50,
    workers=(0,),
    seconds=0.1,
    people=((2, 1, 1),),
    training=("trainer=cpu", "trainer.max_steps=4", "trainer.val_check_interval=2", "views=v3"),
)


class Rows:
    """A file of findings, a line of JSON each,
    which holds whatever was found before a process ended."""

    def __init__(self, file: Path):
        self.file = file

    def add(self, **values: Any) -> None:
        """Write a line at once."""
        with self.file.open("a") as lines:
            lines.write(json.dumps(values) + "\n")

    def read(self) -> list[dict[str, Any]]:
        """All lines so far."""
        lines = self.file.read_text().splitlines() if self.file.exists() else []
        return [json.loads(line) for line in lines]


@dataclass(frozen=True)
class Call:
    """What a section is called with."""

    gpu: Gpu
    rows: "Rows"
    section: str
    sizes: Sizes
    work: Path
    overrides: list[str] = field(default_factory=list)

    def add(self, row: str, **numbers: Any) -> None:
        """Write a row at once."""
        self.rows.add(section=self.section, row=row, **numbers)

    @property
    def rendered(self) -> list[int]:
        """Numbers of the people that are there: in training, active ones, in validation."""
        return [row["numbers"] for row in self.rows.read() if "numbers" in row][-1]

    def run(self, *overrides: str) -> Run:
        return run_of("train", list(overrides))

    @property
    def shipped(self) -> list[str]:
        """Overrides of the training of the weights that come with the package."""
        return ["experiment=shipped", *self.sizes.shipped]

    def batch(self, size: int, side: int) -> Batch:
        """``size`` subjects on 15 % of the frame, on the CPU, with depths and bodies."""
        batch = ellipsoid_batch(0.15, self.sizes.views, side, size)
        vertices = [torch.rand(self.sizes.vertices, 3) for _ in range(size)]
        batch = replace(batch, depths=2.0 * batch.masks, body_vertices=vertices)
        return batch.pin_memory() if self.gpu.is_real else batch
