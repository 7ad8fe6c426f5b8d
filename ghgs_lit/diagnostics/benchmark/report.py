"""Rows, budgets and tables of a benchmark."""

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from ghgs_lit.diagnostics.benchmark.measure import TOTAL, Record
from ghgs_lit.diagnostics.machine import in_words
from ghgs_lit.diagnostics.output import Tables, document, pivoted, save_figure, texts
from ghgs_lit.files import write_text_atomically
from ghgs_lit.runs.results import Row, plain, summarize

#: Metrics beside PSNR in the row ``total`` of a case, if known.
ERRORS = (
    "psnr_box",
    "ssim",
    "ssim_box",
    "flip",
    "flip_box",
    "lpips",
    "psnr_box_40",
    "psnr_edge",
    "spill",
    "sharpness",
    "depth_error_mm",
)

#: Columns and formats of the table of cases, by heading.
_COLUMNS = {
    "preset": ("preset", "{}"),
    "s (quartiles)": ("quartiles", "{}"),
    "speed-up": ("speed_up", "{:.2f}"),
    "peak MB": ("peak_mb", "{:.0f}"),
    "GFLOP": ("gflop", "{:.2f}"),
    "tokens": ("tokens", "{:.0f}"),
    "points": ("points", "{:.0f}"),
    "Gaussians": ("gaussians", "{:.0f}"),
    "PLY MB": ("ply_mb", "{:.2f}"),
    "max rel diff": ("max_rel_diff", "{:.1e}"),
    "over condition": ("rel_diff", "{:.1e}"),
    "PSNR": ("psnr", "{:.2f}"),
    "loss dB": ("psnr_loss_db", "{:+.3f}"),
    "psnr_box": ("psnr_box", "{:.2f}"),
    "ssim": ("ssim", "{:.4f}"),
    "flip": ("flip", "{:.4f}"),
    "depth_error_mm": ("depth_error_mm", "{:.1f}"),
    "budget dB": ("budget_db", "{:.3f}"),
    "budget": ("budget", "{}"),
}


def rows_of(records: Sequence[Record]) -> list[Row]:
    """Rows of the tables and of ``benchmark.json``.

    Args:
        records: the yardstick first.

    Returns:
        One row for each case and stage; row ``total`` also has errors and budgets.
    """
    rows: list[Row] = []
    for record in records:
        (means,) = summarize(record.metrics)
        if record.case.is_yardstick:
            psnr_of_none = means["psnr"]
        works = pd.DataFrame(record.works)
        total = {
            **works.mean().to_dict(),
            "peak_bytes": float(works.peak_bytes.max()),
            **{name: record.differences[name] for name in ("max_rel_diff", "rel_diff")},
            "psnr": means["psnr"],
            "psnr_loss_db": psnr_of_none - means["psnr"],
            "difference_db": difference_db(record.differences["mse_to_none"], psnr_of_none),
            "budget_db": record.case.budget_db,
            "max_rel_diff_budget": record.case.max_rel_diff,
            "trained": record.case.is_trained,
            **{name: means[name] for name in ERRORS if name in means},
            "differences": record.differences,
        }
        for stage, seconds in record.seconds.items():
            low, median, high = np.quantile(seconds, (0.25, 0.5, 0.75)).tolist()
            row = {"preset": record.case.label, "stage": stage, "seconds": median}
            row |= {"seconds_low": low, "seconds_high": high, "psnr": None}
            rows.append(row | total if stage == TOTAL else row)
    return rows


def difference_db(mse: float, psnr: float) -> float:
    """PSNR that renders lose by a difference that is independent of their error.

    Unlike the loss against the truth it cannot be 0 or negative by chance.

    Args:
        mse: mean squared difference of the renders, of images in [0, 1].
        psnr: of the renders without the difference, in dB.

    Returns:
        The loss in dB, at least 0.
    """
    return 10 * math.log10(1 + mse * 10 ** (psnr / 10))


def broken_budgets(rows: Sequence[Row]) -> list[str]:
    """Broken budgets, one line each. PSNR counts for trained weights only;
    differences count for all.

    Args:
        rows: as of :func:`rows_of`.
    """
    lines = []
    for row in totals(rows):
        lines += [f"{row['preset']}: {line}" for line in _broken(row)]
    return lines


def _broken(row: Row) -> list[str]:
    """Why a row ``total`` breaks its budget, one line for each reason; none: it is kept."""
    lines = []
    limit = row["max_rel_diff_budget"]
    difference = row["rel_diff"]
    if limit is not None and not difference <= limit:
        lines.append(f"expected rel_diff up to max_rel_diff={limit:g}; found {difference:g}")
    missing = row["differences"]["unmatched"]
    if limit is not None and missing > 0:
        lines.append(f"expected the Gaussians of none; found {missing:.2%} others")
    promises_equality = limit is not None
    limit = row["budget_db"]
    loss = max(row["psnr_loss_db"], row["difference_db"] if promises_equality else -math.inf)
    if row["trained"] and limit is not None and not loss <= limit:
        lines.append(f"expected a loss up to {limit:g} dB of PSNR; found {loss:.3g}")
    return lines


def totals(rows: Sequence[Row]) -> list[Row]:
    """Rows of whole cases."""
    return [row for row in rows if row["stage"] == TOTAL]


def tables_of(rows: Sequence[Row]) -> Tables:
    """Tables of cost and error of cases, and of the seconds of their stages.

    Args:
        rows: as of :func:`rows_of`.
    """

    def promises(row: Row) -> bool:
        return row["max_rel_diff_budget"] is not None or (row["trained"] and row["budget_db"] is not None)

    whole = pd.DataFrame(totals(rows))
    times = whole[["seconds", "seconds_low", "seconds_high"]].itertuples(index=False)
    cases = whole.assign(
        quartiles=["{:.3f} ({:.3f} to {:.3f})".format(*quartiles) for quartiles in times],
        speed_up=whole.seconds.iloc[0] / whole.seconds,
        peak_mb=whole.peak_bytes.astype(float) / 1e6,
        gflop=whole.flops.astype(float) / 1e9,
        ply_mb=whole.ply_bytes / 1e6,
        budget=["broken" if _broken(row) else "kept" if promises(row) else "-" for row in totals(rows)],
    )
    stages = pivoted(pd.DataFrame(rows), "preset", "stage", "seconds", "{:.4f}")
    return {"Presets": texts(cases, _COLUMNS), "Seconds by stage": stages}


def notes_of(content: Mapping[str, Any]) -> list[str]:
    """Notes above the tables.

    Args:
        content: of ``benchmark.json``.
    """
    notes = [f"Machine: {in_words(content['machine'])}.", content["about"]]
    if content["random_weights"]:
        notes.append("The weights are random: PSNR says nothing, only run times and differences do.")
    return notes + [f"Budget broken: {line}." for line in content["broken"]]


def draw(rows: Sequence[Row]) -> Figure:
    """Run time against PSNR, a dot for each case; the line is the Pareto front.

    Args:
        rows: as of :func:`rows_of`.
    """
    front: list[Row] = []
    for row in sorted(totals(rows), key=lambda row: (row["seconds"], -row["psnr"])):
        if not front or row["psnr"] > front[-1]["psnr"]:
            front.append(row)
    figure = Figure(figsize=(7, 4.5), layout="constrained")
    axes = figure.add_subplot(xlabel="run time of a batch in ms", ylabel="PSNR in dB")
    curve = [1e3 * row["seconds"] for row in front], [row["psnr"] for row in front]
    axes.plot(*curve, "-o", color="gold", markersize=14, label="Pareto front")
    for row in totals(rows):
        place = 1e3 * row["seconds"], row["psnr"]
        axes.plot(*place, "o")
        axes.annotate(row["preset"], place, xytext=(5, 5), textcoords="offset points")
    axes.margins(0.15)
    axes.legend()
    return figure


def write_numbers(directory: Path, content: Mapping[str, Any], tables: Tables) -> Path:
    """Write ``benchmark.md``, ``benchmark.png`` and ``benchmark.json``.

    Args:
        directory: the run's.
        content: of the JSON file.
        tables: of the Markdown file.

    Returns:
        Path of the JSON file.
    """
    write_text_atomically(directory / "benchmark.md", document("Benchmark", notes_of(content), tables))
    save_figure(draw(content["rows"]), directory / "benchmark.png")
    path = directory / "benchmark.json"
    write_text_atomically(path, json.dumps(plain(content), indent=1, allow_nan=False) + "\n")
    return path
