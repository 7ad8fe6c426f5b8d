"""Layouts of tables (the paper's four, the ablation at several numbers of views) and
their parts."""

import itertools
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import pandas as pd

from ghgs_lit.config.nodes import PairedTest
from ghgs_lit.errors import choice
from ghgs_lit.evaluation.tables.records import TRAINING, Planned
from ghgs_lit.evaluation.tables.variants import Variant
from ghgs_lit.parsing import read_yaml

DECIMALS = {"psnr": 2, "ssim": 4, "lpips": 4, "flip": 4, "depth_error_mm": 1, "surface_mm": 1}
DECIMALS |= {"gaussians": 0, "spill": 1, "sharpness": 2}
DECIMALS |= {"prediction_seconds": 3, "steps": 0, "seconds": 0, "peak_gb": 1}
HIGHER_IS_BETTER = ("psnr", "ssim")
LOWER_IS_BETTER = ("lpips", "flip", "spill", "depth_error_mm", "surface_mm")
LOWER_IS_BETTER += ("prediction_seconds", "seconds", "peak_gb")
TITLES = {
    "depth_error_mm": "Depth error (mm)",
    "surface_mm": "Surface error (mm)",
    "shared_neighbors": "Shared neighbours",
    "gaussians": "Gaussians",
    "psnr_box_40": "PSNR box at 0.40",
    "spill": "Spill (‰)",
    "sharpness": "Sharpness",
    "prediction_seconds": "Prediction (s)",
    "steps": "Training steps",
    "seconds": "Training (s)",
    "peak_gb": "Training memory (GB)",
}


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


def _stem(metric: str) -> str:
    """Metric without its region: ``psnr`` for ``psnr_box``."""
    return metric if metric in DECIMALS else metric.split("_")[0]


def decimals(metric: str) -> int:
    """Decimals of a metric, as in the paper.

    Args:
        metric: Name, with its region.

    Returns:
        Number of decimals.
    """
    return DECIMALS.get(_stem(metric), 4)


def arrow(metric: str) -> str:
    """Which direction of a metric is better.

    Args:
        metric: Name, with its region.

    Returns:
        ↑: higher is better; ↓: lower; empty: neither, or not known.
    """
    stem = _stem(metric)
    return "↑" if stem in HIGHER_IS_BETTER else "↓" if stem in LOWER_IS_BETTER else ""


def title(metric: str) -> str:
    """Title of a metric.

    Args:
        metric: Name, with its region, such as ``psnr_box``.

    Returns:
        Text such as ``PSNR box``.
    """
    stem, _, region = metric.partition("_")
    return TITLES.get(metric) or f"{stem.upper()} {region}".strip()


@dataclass(frozen=True)
class Group:
    """Columns below one heading: the metrics on ``data`` (None: the table's) with ``views``
    input views."""

    title: str
    views: int
    data: str | None = None


@dataclass(frozen=True)
class Line:
    """A row of a table: a variant and its texts in the first columns."""

    variant: Variant
    stub: tuple[str, ...]

    @property
    def is_ours(self) -> bool:
        """Whether this is a trained model of ours."""
        return self.variant.kind == "model"

    @property
    def is_reported(self) -> bool:
        """Whether the figures are the paper's."""
        return self.variant.kind == "reported"

    @property
    def competes(self) -> bool:
        """Whether the row can be best and is tested;
        baselines, some of which know the truth, do not."""
        return self.variant.kind in ("model", "other")


CELL = ["line", "group", "metric"]
"""What tells the cells of a table apart: numbers of the line and of the group of columns,
and the metric."""


@dataclass
class Table:
    """A table, with everything that a writer of a format needs.

    Attributes:
        options: What it shows.
        rows: Measurements, as in :class:`Sweep`.
        planned: Training runs of the table, finished or not.
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
    def ours(self) -> list[Line]:
        """Rows of our models."""
        return [line for line in self.lines if line.is_ours]

    @property
    def measured(self) -> pd.DataFrame:
        """Cells with a measured, not reported, number."""
        known = self.cells[self.cells["mean"].notna()]
        reported = [self.lines[i].is_reported for i in known.index.get_level_values("line")]
        return known.loc[[not is_reported for is_reported in reported]]

    @property
    def blocks(self) -> list[list[int]]:
        """Indices of reported rows, then of measured rows; empty blocks are left out."""
        reported = [i for i, line in enumerate(self.lines) if line.is_reported]
        measured = [i for i, line in enumerate(self.lines) if not line.is_reported]
        return [block for block in (reported, measured) if block]

    def block_title(self, block: list[int]) -> str:
        """Title of a block, for tables with reported rows.

        Args:
            block: Numbers of lines, as in :attr:`blocks`.

        Returns:
            Whether they are reported or measured.
        """
        reported = f"as reported on {self.reported_on}, not measured here"
        return reported if self.lines[block[0]].is_reported else "measured here"


@cache
def _content() -> dict[str, Any]:
    return read_yaml(Path(__file__).parent / "reported.yaml")


def data_title(name: str) -> str:
    """The paper's name of a data set.

    Args:
        name: In any spelling, such as ``zju_mocap``.

    Returns:
        Its name in the paper, else ``name``.
    """
    return _content()["data"].get(re.sub(r"[^a-z0-9]", "", name.lower()), name)


def reported_source() -> str:
    """Reference of the paper."""
    return _content()["source"]


def reported_table(name: str) -> tuple[str, dict[str, dict[int | str, dict[str, float]]]]:
    """Figures of one of the paper's tables.

    Args:
        name: Such as ``table2``.

    Returns:
        Data set of the table, and its rows: method, then views or data, then metric, then figure.
    """
    table = _content()["tables"][name]
    metrics = _content()["metrics"]
    rows = {}
    for method, groups in table["rows"].items():
        rows[method] = {group: dict(zip(metrics, row, strict=True)) for group, row in groups.items()}
    return table["data"], rows


def reported_data(name: str) -> list[str]:
    """Groups of columns of a reported table.

    Args:
        name: Such as ``table2``.

    Returns:
        Data sets or numbers of views.
    """
    return list(dict.fromkeys(itertools.chain.from_iterable(reported_table(name)[1].values())))
