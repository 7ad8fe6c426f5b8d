"""Layouts of tables (the paper's four, the ablation at several numbers of views) and
their parts."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd

from ghgs_lit.config.nodes import PairedTest
from ghgs_lit.errors import choice
from ghgs_lit.evaluation.tables.records import TRAINING, Planned
from ghgs_lit.evaluation.tables.variants import Variant
from ghgs_lit.parsing import read_yaml


class Metric(NamedTuple):
    """How a metric is printed.

    Attributes:
        title: Of its columns.
        decimals: As in the paper.
        arrow: ↑: higher is better; ↓: lower; empty: neither, or not known.
    """

    title: str
    decimals: int
    arrow: str


METRICS = {
    "psnr": Metric("PSNR", 2, "↑"),
    "psnr_box_40": Metric("PSNR box at 0.40", 2, "↑"),
    "ssim": Metric("SSIM", 4, "↑"),
    "lpips": Metric("LPIPS", 4, "↓"),
    "flip": Metric("FLIP", 4, "↓"),
    "depth_error_mm": Metric("Depth error (mm)", 1, "↓"),
    "surface_mm": Metric("Surface error (mm)", 1, "↓"),
    "spill": Metric("Spill (‰)", 1, "↓"),
    "sharpness": Metric("Sharpness", 2, ""),
    "gaussians": Metric("Gaussians", 0, ""),
    "shared_neighbors": Metric("Shared neighbours", 4, ""),
    "prediction_seconds": Metric("Prediction (s)", 3, "↓"),
    "steps": Metric("Training steps", 0, ""),
    "seconds": Metric("Training (s)", 0, "↓"),
    "peak_gb": Metric("Training memory (GB)", 1, "↓"),
}


def metric_of(name: str) -> Metric:
    """How a metric is printed.

    Args:
        name: With its region, such as ``psnr_box``.

    Returns:
        Its entry of ``METRICS``, else that of the metric without its region.
    """
    stem, _, region = name.partition("_")
    unknown = Metric(stem.upper(), 4, "")
    known = METRICS.get(stem, unknown)
    return METRICS.get(name) or known._replace(title=f"{stem.upper()} {region}".strip())


@dataclass(frozen=True)
class Layout:
    """Rows and groups of columns of a table.

    Attributes:
        name: Of the layout, for ``ghgs table``.
        rows: ``ablation`` (all four combinations) or ``methods``.
        columns: One group for each of ``views`` or ``data``.
        views: Numbers of input views that are shown.
        heading: Of each group: ``views``, ``data`` or ``none``.
        reported: The paper's table whose figures are shown beside the measured ones; None: none.
    """

    name: str
    rows: str
    columns: str
    views: tuple[int, ...]
    heading: str
    reported: str | None = None


LAYOUTS = {
    "ablation": Layout("ablation", "ablation", "views", (3, 4, 5), "views"),
    "table1": Layout("table1", "methods", "data", (4,), "data", "table1"),
    "table2": Layout("table2", "methods", "views", (3, 4, 5), "views", "table2"),
    "table3": Layout("table3", "methods", "views", (4,), "none", "table3"),
    "table4": Layout("table4", "ablation", "views", (4,), "data", "table4"),
}


@dataclass(frozen=True)
class TableOptions:
    """What a table shows.

    Attributes:
        layout: Rows and columns.
        views: A selection of numbers of views; None: those of the layout.
        targets: A selection of target protocols; None: those of the runs.
        metrics: A selection of metrics; None: those of the runs.
        reported: Whether the paper's figures are shown where the layout has some.
        test: How rows are compared.
        unit: Regular expression whose first group is the person, if subjects are frames of people.
        subjects: Regular expression of the names of a selection of subjects; None: all.
    """

    layout: Layout
    views: tuple[int, ...] | None = None
    targets: tuple[str, ...] | None = None
    metrics: tuple[str, ...] | None = None
    reported: bool = True
    test: PairedTest = field(default_factory=PairedTest)
    unit: re.Pattern[str] | None = None
    subjects: re.Pattern[str] | None = None


class Group(NamedTuple):
    """Columns below one heading: the metrics on ``data`` (None: the table's) with ``views``
    input views."""

    title: str
    views: int
    data: str | None = None


class Line(NamedTuple):
    """A row of a table: a variant and its texts in the first columns."""

    variant: Variant
    stub: tuple[str, ...]


CELL = ["line", "group", "metric"]
"""What tells the cells of a table apart: numbers of the line and of the group of columns,
and the metric."""


@dataclass
class Table:
    """A table, with everything that a writer of a format needs.

    Attributes:
        options: What it shows.
        rows: Measurements, as in :class:`Sweep`.
        planned: Training runs of the table that have no results yet.
        configs: Configuration of our model by ``source``.
        stub: Headings of the columns that name a row.
        groups: Groups of columns.
        metrics: Names of the metrics of each group.
        lines: Rows of the table.
        cells: By ``CELL``: ``mean`` over subjects and seeds (nan: no number), ``deviation`` over
            seeds, ``seeds`` and ``lacking`` (seeds of planned runs without results) as tuples,
            ``count`` of subjects, ``runs`` (hashes or files), ``best`` (of its column, as printed),
            ``test`` (a :class:`Comparison` or None), ``marked`` (significant).
        caption: Above the table.
        notes: Below the table.
        reported_on: Data of the reported figures, if any.
        comparisons: Number of comparisons that are corrected together.
        others: Number of runs that the table does not show.
    """

    options: TableOptions
    rows: pd.DataFrame
    planned: list[Planned]
    configs: Mapping[str, Mapping[str, Any]]
    stub: tuple[str, ...]
    groups: list[Group]
    metrics: list[str]
    lines: list[Line]
    cells: pd.DataFrame = field(default_factory=pd.DataFrame)
    caption: str = ""
    notes: list[str] = field(default_factory=list)
    reported_on: str | None = None
    comparisons: int = 0
    others: int = 0

    @property
    def layout(self) -> Layout:
        return self.options.layout

    @property
    def tested(self) -> list[str]:
        """Metrics that are tested: the option's, else the first that subjects have.

        Raises:
            InputError: The option names a metric that the table lacks.
        """
        chosen = self.options.test.metrics
        if chosen is None:
            return [name for name in self.metrics if name not in TRAINING][:1]
        names = (chosen,) if isinstance(chosen, str) else chosen
        for name in names:
            choice("test.metrics", name, tuple(self.metrics))
        return list(names)

    @property
    def ours(self) -> list[Variant]:
        """Variants of our models, by row."""
        return [line.variant for line in self.lines if line.variant.kind == "model"]

    @property
    def measured(self) -> pd.DataFrame:
        """Cells with a measured, not reported, number."""
        return self.cells[self.cells["seeds"].notna()]

    @property
    def blocks(self) -> dict[str, list[int]]:
        """Numbers of the reported lines, then of the measured ones, by title; none is empty."""
        reported = [i for i, line in enumerate(self.lines) if line.variant.kind == "reported"]
        measured = [i for i in range(len(self.lines)) if i not in reported]
        titles = (f"as reported on {self.reported_on}, not measured here", "measured here")
        blocks = dict(zip(titles, (reported, measured), strict=True))
        return {title: block for title, block in blocks.items() if block}


@cache
def paper() -> dict[str, Any]:
    """What the paper's tables print, as in ``reported.yaml``."""
    return read_yaml(Path(__file__).parent / "reported.yaml")


def data_title(name: str) -> str:
    """The paper's name of a data set.

    Args:
        name: In any spelling, such as ``zju_mocap``.

    Returns:
        Its name in the paper, else ``name``.
    """
    return paper()["data"].get(re.sub(r"[^a-z0-9]", "", name.lower()), name)
