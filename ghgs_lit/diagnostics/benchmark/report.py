"""The rows of a benchmark, what its budgets say, and its tables."""

import csv
import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table as RichTable

from ghgs_lit.diagnostics.benchmark.machine import in_words
from ghgs_lit.diagnostics.benchmark.measure import Record
from ghgs_lit.diagnostics.benchmark.stages import NAMES, TOTAL
from ghgs_lit.files import write_text_atomically
from ghgs_lit.runs.results import Row, plain, summarize

#: Means of a case that its row ``total`` has beside PSNR, where they are known.
ERRORS = ("psnr_box", "ssim", "ssim_box", "flip", "flip_box", "lpips", "depth_error_mm")


@dataclass(frozen=True)
class Table:
    """A table of texts."""

    title: str
    header: tuple[str, ...]
    lines: tuple[tuple[str, ...], ...]


def rows_of(records: Sequence[Record]) -> list[Row]:
    """One row for each case and stage; the row ``total`` has the errors and the budgets, too.

    Args:
        records: of each source the yardstick first.
    """
    rows: list[Row] = []
    for record in records:
        (means,) = summarize(record.metrics)
        if record.case.is_yardstick:
            psnr_of_none = means["psnr"]
        total = {
            "max_rel_diff": record.differences["max_rel_diff"],
            "psnr": means["psnr"],
            "psnr_loss_db": psnr_of_none - means["psnr"],
            "budget_db": record.case.budget_db,
            "max_rel_diff_budget": record.case.max_rel_diff,
            "trained": record.case.is_trained,
            **{name: means[name] for name in ERRORS if name in means},
            **record.work.counts,
            "differences": record.differences,
        }
        rows += [stage_row(record, stage, total if stage == TOTAL else {}) for stage in record.times]
    return rows


def stage_row(record: Record, stage: str, about: Mapping[str, Any]) -> Row:
    """The row of one stage, with what else is known ``about`` it."""
    times, work = record.times[stage], record.work
    return {
        "model": record.case.source,
        "preset": record.case.label,
        "stage": stage,
        "seconds": times.median,
        "seconds_low": times.low,
        "seconds_high": times.high,
        "peak_bytes": work.peaks.get(stage),
        "flops": None if work.flops is None else work.flops.get(stage),
        "max_rel_diff": None,
        "psnr": None,
        "psnr_loss_db": None,
        "budget_db": None,
        **about,
    }


def broken_budgets(rows: Sequence[Row]) -> list[str]:
    """What presets promise and do not keep, in one line each.

    A loss of PSNR says nothing about weights that nobody trained; a difference does.
    """
    return [f"{row['preset']}: {said}" for row in totals(rows) for said in _broken(row)]


def _broken(row: Row) -> list[str]:
    said = []
    limit, found = row["max_rel_diff_budget"], row["max_rel_diff"]
    if limit is not None and not found <= limit:
        said.append(f"expected max_rel_diff up to {limit:g}; found {found:g}")
    missing = row["differences"]["unmatched"]
    if limit is not None and missing > 0:
        said.append(f"expected the Gaussians of none; found {missing:.2%} others")
    limit, found = row["budget_db"], row["psnr_loss_db"]
    if row["trained"] and limit is not None and not found <= limit:
        said.append(f"expected a loss up to {limit:g} dB of PSNR; found {found:.3g}")
    return said


def totals(rows: Sequence[Row]) -> list[Row]:
    """The rows of whole cases."""
    return [row for row in rows if row["stage"] == TOTAL]


def tables_of(rows: Sequence[Row]) -> list[Table]:
    """Cases with their cost and error, then the seconds of their stages."""
    whole = totals(rows)
    yardsticks: dict[str, float] = {}
    for row in whole:
        yardsticks.setdefault(row["model"], row["seconds"])
    lines = []
    for row in whole:
        promises = row["max_rel_diff_budget"] is not None
        promises |= row["trained"] and row["budget_db"] is not None
        kept = "broken" if _broken(row) else "kept" if promises else "-"
        lines.append(
            (
                row["preset"],
                f"{row['seconds']:.3f} ({row['seconds_low']:.3f} to {row['seconds_high']:.3f})",
                f"{yardsticks[row['model']] / row['seconds']:.2f}",
                _scaled(row["peak_bytes"], 1e6, 0),
                _scaled(row["flops"], 1e9, 2),
                *(f"{row[name]:.0f}" for name in ("tokens", "points", "gaussians")),
                _scaled(row["ply_bytes"], 1e6, 2),
                f"{row['max_rel_diff']:.1e}",
                f"{row['psnr']:.2f}",
                f"{row['psnr_loss_db']:+.3f}",
                *(_scaled(row.get(name), 1, digits) for name, digits in _SHOWN.items()),
                _scaled(row["budget_db"], 1, 3),
                kept,
            )
        )
    header = ("preset", "s (quartiles)", "speed-up", "peak MB", "GFLOP", "tokens", "points", "Gaussians")
    header += ("PLY MB", "max rel diff", "PSNR", "loss dB", *_SHOWN, "budget dB", "budget")
    return [Table("Presets", header, tuple(lines)), _stages(rows)]


#: Further errors of the table, with their decimals.
_SHOWN = {"psnr_box": 2, "ssim": 4, "flip": 4, "depth_error_mm": 1}


def _stages(rows: Sequence[Row]) -> Table:
    presets = list(dict.fromkeys(row["preset"] for row in rows))
    seconds = {(row["preset"], row["stage"]): row["seconds"] for row in rows}
    lines = [
        (stage, *(f"{seconds[preset, stage]:.4f}" for preset in presets))
        for stage in NAMES
        if (presets[0], stage) in seconds
    ]
    return Table("Seconds by stage", ("stage", *presets), tuple(lines))


def _scaled(value: float | None, unit: float, digits: int) -> str:
    return "-" if value is None else f"{value / unit:.{digits}f}"


def to_markdown(tables: Sequence[Table], notes: Sequence[str]) -> str:
    """Tables below the ``notes``."""
    lines = ["# Benchmark", "", *(f"{note}\n" for note in notes)]
    for table in tables:
        lines += [f"## {table.title}", "", f"| {' | '.join(table.header)} |"]
        lines += ["|" + "---|" * len(table.header)]
        lines += [f"| {' | '.join(line)} |" for line in table.lines] + [""]
    return "\n".join(lines)


def print_tables(tables: Sequence[Table]) -> None:
    """Print the tables; a line that wraps is better than a number that is cut."""
    for table in tables:
        printed = RichTable(*table.header, title=table.title)
        for line in table.lines:
            printed.add_row(*line)
        needed = Console(width=1000).measure(printed).maximum
        Console(width=max(Console().width, needed)).print(printed)


def notes_of(content: Mapping[str, Any]) -> list[str]:
    """What a reader of the numbers must know."""
    notes = [f"Machine: {in_words(content['machine'])}.", content["about"]]
    if content["random_weights"]:
        notes.append("The weights are random: PSNR says nothing, only run times and differences do.")
    return notes + content.get("decisions", []) + [f"Budget broken: {said}." for said in content["broken"]]


def write_numbers(directory: Path, content: Mapping[str, Any], tables: Sequence[Table]) -> Path:
    """Write ``benchmark.csv``, ``benchmark.md`` and ``benchmark.json``; returns the path of the last."""
    rows = [{name: value for name, value in row.items() if name != "differences"} for row in content["rows"]]
    text = io.StringIO()
    writer = csv.DictWriter(
        text, list(dict.fromkeys(name for row in rows for name in row)), restval="", lineterminator="\n"
    )
    writer.writeheader()
    writer.writerows(plain(rows))
    write_text_atomically(directory / "benchmark.csv", text.getvalue())
    write_text_atomically(directory / "benchmark.md", to_markdown(tables, notes_of(content)))
    path = directory / "benchmark.json"
    write_text_atomically(path, json.dumps(plain(content), indent=1, allow_nan=False) + "\n")
    return path
