"""How tables are laid out: the paper's four, and the ablation at every number of views."""

from dataclasses import dataclass, field
from typing import Any

from ghgs_lit.errors import choice
from ghgs_lit.tables.records import Variant
from ghgs_lit.tables.significance import Comparison

DECIMALS = {"psnr": 2, "ssim": 4, "lpips": 4, "flip": 4, "depth_error_mm": 1, "seconds": 3, "gaussians": 0}
LOWER_IS_BETTER = ("lpips", "flip", "depth_error_mm", "seconds")
TITLES = {"depth_error_mm": "Depth error (mm)", "seconds": "Seconds", "gaussians": "Gaussians"}


@dataclass(frozen=True)
class Layout:
    """Rows (``ablation``: all four; ``methods``) and groups of columns (``views`` or ``data``)."""

    name: str
    rows: str
    columns: str
    views: tuple[int, ...]
    heading: str
    """Above each group of columns: its ``views``, its ``data``, or ``none``."""
    reported: str | None = None
    """The paper's table whose figures are shown beside the measured ones."""


LAYOUTS = {
    "ablation": Layout("ablation", "ablation", "views", (3, 4, 5), "views"),
    "table1": Layout("table1", "methods", "data", (4,), "data", "table1"),
    "table2": Layout("table2", "methods", "views", (3, 4, 5), "views", "table2"),
    "table3": Layout("table3", "methods", "views", (4,), "none", "table3"),
    "table4": Layout("table4", "ablation", "views", (4,), "data", "table4"),
}


def layout_named(name: str) -> Layout:
    """One of ``LAYOUTS``."""
    choice("layout", name, tuple(LAYOUTS))
    return LAYOUTS[name]


def _stem(metric: str) -> str:
    """The metric without its region: ``psnr_box`` is a PSNR."""
    return metric if metric in DECIMALS else metric.split("_")[0]


def decimals(metric: str) -> int:
    """Digits after the point, as the paper prints them."""
    return DECIMALS.get(_stem(metric), 4)


def arrow(metric: str) -> str:
    """The direction of better; empty where there is none."""
    stem = _stem(metric)
    return "" if stem == "gaussians" else "↓" if stem in LOWER_IS_BETTER else "↑"


def title(metric: str) -> str:
    """``psnr_box`` as ``PSNR box``."""
    stem, _, region = metric.partition("_")
    return TITLES.get(metric) or f"{stem.upper()} {region}".strip()


@dataclass(frozen=True)
class Group:
    """Columns under one heading: the metrics on ``data`` (None: the table's) from ``views`` inputs."""

    title: str
    views: int
    data: str | None = None


Column = tuple[Group, str]


@dataclass
class Cell:
    """What stands behind one number: a mean over subjects for each seed, and each subject over the seeds."""

    seeds: dict[int, float] = field(default_factory=dict)
    lacking: tuple[int, ...] = ()
    """Seeds that other runs of the sweep have and this cell has not."""
    by_seed: dict[str, list[float]] = field(default_factory=dict)
    subjects: dict[str, float] = field(default_factory=dict)
    """Each subject's mean over the seeds."""
    count: int | None = None
    runs: list[str] = field(default_factory=list)
    best: bool = False
    test: Comparison | None = None
    marked: bool = False
    """Whether it differs from the reference row beyond chance."""

    @property
    def mean(self) -> float:
        return sum(self.seeds.values()) / len(self.seeds)


@dataclass
class Line:
    """A row of a table: a variant, how it is printed on the left, and a cell a column that has one."""

    variant: Variant
    stub: tuple[str, ...]
    cells: dict[Column, Cell] = field(default_factory=dict)
    absent: str = "missing"
    """What stands where there is no number."""


@dataclass
class Table:
    """One table: everything that a writer needs."""

    layout: Layout
    about: dict[str, Any]
    stub: tuple[str, ...]
    groups: list[Group]
    metrics: list[str]
    lines: list[Line]
    caption: str = ""
    notes: list[str] = field(default_factory=list)
    reported_on: str | None = None

    @property
    def columns(self) -> list[Column]:
        return [(group, metric) for group in self.groups for metric in self.metrics]

    @property
    def blocks(self) -> list[list[Line]]:
        """Reported rows and measured rows, the blocks that have any."""
        reported = [line for line in self.lines if line.variant.kind == "reported"]
        measured = [line for line in self.lines if line.variant.kind != "reported"]
        return [block for block in (reported, measured) if block]
