"""Layouts of tables (the paper's four, and the ablation at several numbers of views), and printed forms."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd

from ghgs_lit.evaluation.tables.runs import Variant
from ghgs_lit.parsing import read_yaml


class Metric(NamedTuple):
    """Printed form of a metric; the arrow is ↑ where higher is better, ↓ where lower is, else empty."""

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
    """Printed form of a metric such as ``psnr_box``: its entry, else that of the metric without its
    region."""
    stem, _, region = name.partition("_")
    known = METRICS.get(stem, Metric("", 4, ""))
    return METRICS.get(name) or known._replace(title=f"{stem.upper()} {region}".strip())


class Layout(NamedTuple):
    """Rows and groups of columns of a table.

    Attributes:
        name: Name of the layout in ``ghgs table``, and of the paper's table whose figures are printed
            next to the measured ones, if there is one.
        rows: ``ablation`` (all four combinations) or ``methods``.
        columns: One group for each of ``views`` or ``data``.
        views: Numbers of input views in the table.
    """

    name: str
    rows: str
    columns: str
    views: tuple[int, ...]


LAYOUTS = {
    "ablation": Layout("ablation", "ablation", "views", (3, 4, 5)),
    "table1": Layout("table1", "methods", "data", (4,)),
    "table2": Layout("table2", "methods", "views", (3, 4, 5)),
    "table3": Layout("table3", "methods", "views", (4,)),
    "table4": Layout("table4", "ablation", "views", (4,)),
}


CELL = ["line", "group", "metric"]
"""Index of a cell: numbers of the line and of the group of columns, and the metric."""


class Group(NamedTuple):
    """Columns below one heading: the metrics on ``data`` (None: the table's) with ``views`` input
    views."""

    title: str
    views: int
    data: str | None = None


class Line(NamedTuple):
    """A row of a table: a variant and its texts in the first columns."""

    variant: Variant
    stub: tuple[str, ...]


@dataclass
class Table:
    """A table, with everything that writers of all formats need.

    Attributes:
        layout: Rows and columns.
        rows: Measurements, as in :class:`ghgs_lit.evaluation.tables.runs.Sweep`.
        planned: Rows of training runs that have no results yet.
        configs: Configuration of our model by ``source``.
        left_out: Number of runs that are not in the table.
        metrics: Names of the metrics of each group.
        reported_on: Titles of the data of the reported figures, if any.
        groups: Groups of columns.
        stub: Headings of the columns that name a row.
        lines: Rows of the table.
        cells: By ``CELL``: ``mean`` over subjects and seeds (nan: no number), ``deviation`` over
            seeds, ``seeds`` and ``lacking`` (seeds of planned runs without results) as tuples,
            ``count`` of subjects, ``runs`` (hashes), ``best`` (of its column, as printed), ``marked``
            (significant), and the :class:`ghgs_lit.evaluation.tables.significance.Comparison` with
            the column's reference, prefixed with ``test_``.
        comparisons: Number of comparisons that are corrected together.
    """

    layout: Layout
    rows: pd.DataFrame
    planned: pd.DataFrame
    configs: Mapping[str, Mapping[str, Any]]
    left_out: int
    metrics: list[str]
    reported_on: list[str]
    groups: list[Group]
    stub: tuple[str, ...]
    lines: list[Line]
    cells: pd.DataFrame = field(default_factory=pd.DataFrame)
    comparisons: int = 0

    @property
    def is_ablation(self) -> bool:
        return self.layout.rows == "ablation"

    @property
    def measured(self) -> pd.DataFrame:
        """Cells with a measured, not reported, number."""
        return self.cells[self.cells["seeds"].notna()]


@cache
def paper() -> dict[str, Any]:
    """The paper's printed figures, as in ``reported.yaml``."""
    return read_yaml(Path(__file__).with_name("reported.yaml"))


def data_title(name: str) -> str:
    """The paper's name of a data set in any spelling, such as ``zju_mocap``; else ``name``."""
    return paper()["data"].get(re.sub(r"[^a-z0-9]", "", name.lower()), name)
