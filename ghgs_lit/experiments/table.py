"""The paper's ablation table out of a directory of runs: rows of its Table 4, columns of its Table 2."""

import csv
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rich.table import Table

from ghgs_lit.errors import InputError
from ghgs_lit.experiments.results import read_results, summarize

# Unprojection, semantic consistency; the paper prints the last three.
ROWS = ((False, False), (False, True), (True, False), (True, True))
DECIMALS = {"psnr": 2, "ssim": 4, "lpips": 4, "flip": 4}
ARROWS = {"psnr": "↑", "ssim": "↑", "lpips": "↓", "flip": "↓"}
FOOTNOTE = (
    "All four combinations are listed. The paper's Table 4 prints three and has (✗, ✓) among them, while its"
    " text says that semantic consistency alone is not included. Without 3D unprojection there are no token"
    " points: neighbours are then found on the image plane."
)
NO_SEMANTICS = "features carry no semantics: this encoder was never trained for semantics"
ILLUSTRATION = "This is an illustration of the framework on a small model, not a result."
MISSING = "missing"

Cell = tuple[bool, bool, int, str]
"""Unprojection, semantic consistency, number of views, metric."""


@dataclass(frozen=True)
class Setting:
    """What the runs of one table have in common."""

    data: str
    split: str
    targets: str
    protocol: str
    model: str
    encoder: str
    has_semantics: bool


@dataclass
class TableData:
    """The means over subjects that stand behind one table: cell -> seed -> (mean, source)."""

    setting: Setting
    subjects: set[int] = field(default_factory=set)
    cells: dict[Cell, dict[int, tuple[float, Path]]] = field(default_factory=dict)

    def values(self, cell: Cell) -> list[float]:
        return [mean for mean, _ in self.cells.get(cell, {}).values()]

    def metrics(self) -> list[str]:
        """PSNR, SSIM and LPIPS; FLIP stands in for LPIPS where a run lacks it."""
        reported = {cell[:3] for cell in self.cells}
        has_lpips = all((*where, "lpips") in self.cells for where in reported)
        return ["psnr", "ssim", "lpips" if has_lpips else "flip"]


def _setting(source: Mapping[str, Any], targets: str) -> Setting:
    config, picked = source["config"], source.get("choices", {})
    # Only an encoder that starts from published weights has seen anything but this data's photographs.
    return Setting(
        data=str(source["data"]["name"]),
        split=source["data"]["split"],
        targets=targets,
        protocol=source["protocol"]["metrics"],
        model=str(config.get("model", {}).get("name", "unnamed")),
        encoder=picked.get("encoder", "unnamed"),
        has_semantics=bool(config.get("encoder", {}).get("weights")),
    )


def collect(sweep: Path, targets: Sequence[str] | None = None) -> list[TableData]:
    """All ``metrics.json`` below ``sweep``, one table for each setting that occurs.

    Raises ``InputError`` where there are none, or where two runs claim the same cell and seed.
    """
    if not sweep.is_dir():
        raise FileNotFoundError(f"{sweep}: expected a directory of runs; found none")
    paths = sorted(sweep.rglob("metrics.json"))
    if not paths:
        raise InputError(f"{sweep}: expected runs with a metrics.json below it; found none")
    tables: dict[Setting, TableData] = {}
    for path in paths:
        content = read_results(path)
        source = content["provenance"]
        ablation = source["config"].get("ablation")
        if ablation is None:
            raise InputError(f"{path}: expected a run with ablation=...; found none in its configuration")
        for means in summarize(content["rows"]):
            if means["method"] != "model" or (targets and means["targets"] not in targets):
                continue
            setting = _setting(source, means["targets"])
            table = tables.setdefault(setting, TableData(setting))
            table.subjects.add(means["subjects"])
            for metric in DECIMALS:
                if means.get(metric) is None:
                    continue
                cell = (ablation["unprojection"], ablation["semantic"], means["views"], metric)
                seeds = table.cells.setdefault(cell, {})
                if source["seed"] in seeds:
                    raise InputError(
                        f"{path}: expected one run for ablation={ablation['name']}, {means['views']} views,"
                        f" seed {source['seed']}; found {seeds[source['seed']][1]} too"
                    )
                seeds[source["seed"]] = (means[metric], path)
    if not tables:
        raise InputError(f"{sweep}: expected runs on targets {targets}; found others only")
    return list(tables.values())


def deviation(values: Sequence[float]) -> float | None:
    """Sample standard deviation; None for fewer than two values."""
    if len(values) < 2:
        return None
    center = sum(values) / len(values)
    return math.sqrt(sum((v - center) ** 2 for v in values) / (len(values) - 1))


def _text(values: Sequence[float], metric: str) -> str:
    digits, spread = DECIMALS[metric], deviation(values)
    center = sum(values) / len(values)
    return f"{center:.{digits}f}" + (f" ± {spread:.{digits}f}" if spread is not None else "")


def _best(table: TableData, views: int, metric: str) -> str | None:
    """The best mean of a column, as printed; None where there is no better and worse."""
    found = [table.values((*row, views, metric)) for row in ROWS]
    means = [sum(v) / len(v) for v in found if v]
    if not means or f"{min(means):.{DECIMALS[metric]}f}" == f"{max(means):.{DECIMALS[metric]}f}":
        return None
    best = max(means) if ARROWS[metric] == "↑" else min(means)
    return f"{best:.{DECIMALS[metric]}f}"


def entries(table: TableData, views: Sequence[int]) -> list[list[tuple[str, bool]]]:
    """The table's rows as printed: texts, and whether each is the best of its column."""
    columns = [(n, m) for n in views for m in table.metrics()]
    best = {column: _best(table, *column) for column in columns}
    rows = []
    for unprojection, semantic in ROWS:
        note = " (a)" if semantic and not table.setting.has_semantics else ""
        row = [("✓" if unprojection else "✗", False), (("✓" if semantic else "✗") + note, False)]
        for n, m in columns:
            values = table.values((unprojection, semantic, n, m))
            text = _text(values, m) if values else MISSING
            row.append((text, bool(values) and best[n, m] == text.split(" ")[0]))
        rows.append(row)
    return rows


def notes(table: TableData, illustration: bool = False) -> list[str]:
    """What has to be said below the table."""
    said = [f"**{ILLUSTRATION}**"] if illustration else []
    said.append(FOOTNOTE)
    if not table.setting.has_semantics:
        said.append(f"(a) {NO_SEMANTICS}.")
    if "lpips" not in table.metrics():
        said.append("FLIP stands in for the paper's LPIPS, which at least one run could not compute.")
    return said


def caption(table: TableData) -> str:
    """Data, protocol, model and number of runs, in one line."""
    s, seeds = table.setting, sorted({seed for cell in table.cells.values() for seed in cell})
    subjects = " or ".join(map(str, sorted(table.subjects)))
    spread = (
        f"mean over subjects ± deviation over {len(seeds)} seeds" if len(seeds) > 1 else "mean over subjects"
    )
    return (
        f"Data `{s.data}`, {subjects} subjects of `{s.split}`, targets `{s.targets}`, metrics `{s.protocol}`,"
        f" model `{s.model}`, encoder `{s.encoder}`; {spread}, best in bold."
    )


def to_markdown(table: TableData, views: Sequence[int], illustration: bool = False) -> str:
    """The table with its caption above and its notes below."""
    names = [f"{n}-view {m.upper()} {ARROWS[m]}" for n in views for m in table.metrics()]
    lines = ["| 3D unproj. | Semantic cons. | " + " | ".join(names) + " |", "|:-:|:-:|" + "--:|" * len(names)]
    for row in entries(table, views):
        lines.append("| " + " | ".join(f"**{text}**" if best else text for text, best in row) + " |")
    return "\n\n".join((caption(table), "\n".join(lines), *notes(table, illustration))) + "\n"


def to_terminal(table: TableData, views: Sequence[int]) -> Table:
    """The table alone, for a terminal."""
    printed = Table(padding=(0, 1, 0, 0))
    printed.add_column("3D\nunp.", justify="center", no_wrap=True)
    printed.add_column("sem.\ncons.", justify="center", no_wrap=True)
    for n in views:
        for metric in table.metrics():
            printed.add_column(f"{n}-view\n{metric.upper()} {ARROWS[metric]}", justify="right", no_wrap=True)
    for row in entries(table, views):
        printed.add_row(*(f"[bold green]{text}[/]" if best else text for text, best in row))
    return printed


def to_csv(tables: Sequence[TableData], views: Sequence[int]) -> str:
    """All cells, one a line, with means and deviations in full; empty where a run is missing."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    shared = ("data", "split", "targets", "protocol", "model", "encoder")
    writer.writerow([*shared, "unprojection", "semantic", "views", "metric", "seeds", "mean", "deviation"])
    for table in tables:
        about = [getattr(table.setting, name) for name in shared]
        for row in ROWS:
            for n in views:
                for metric in table.metrics():
                    values = table.values((*row, n, metric))
                    mean = sum(values) / len(values) if values else ""
                    spread = deviation(values)
                    spread = "" if spread is None else spread
                    writer.writerow([*about, *row, n, metric, len(values), mean, spread])
    return text.getvalue()
