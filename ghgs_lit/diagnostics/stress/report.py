"""Report of the stress test as JSON, tables and a picture."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.colors import TwoSlopeNorm
from matplotlib.figure import Figure

from ghgs_lit.diagnostics.output import Tables, document, pivoted, save_figure
from ghgs_lit.diagnostics.stress.measure import Row
from ghgs_lit.diagnostics.stress.stage import FAMILIES
from ghgs_lit.diagnostics.stress.stages import STAGES
from ghgs_lit.files import write_text_atomically

#: Ticks of the picture's colours: log10 of error over budget, and text.
_TICKS = {-6: "1e-6 or less", -4: "1e-4", -2: "1 %", 0: "budget", 3: "1000 or more"}


def bounded(error: float | None) -> str:
    """Text of an error, with three digits.

    Args:
        error: in units of eps times the condition number; None: unbounded.
    """
    return "no bound" if error is None else f"{error:.3g}"


def counts_of(rows: Sequence[Row]) -> str:
    """Numbers of cases and failures, in words."""
    cases = sum(row["cases"] for row in rows)
    failures = sum(row["failures"] for row in rows)
    return f"{cases} cases, {failures} failures"


def tables_of(rows: Sequence[Row]) -> Tables:
    """Worst error of each stage and dtype, beside its cases and its budget.

    Args:
        rows: cells of the matrix.
    """
    frame = pd.DataFrame(rows)
    frame["error"] = frame.error.astype(float).fillna(np.inf)
    worst = frame.groupby(["stage", "dtype"], sort=False).error.max().reset_index()
    table = pivoted(worst, "stage", "dtype", "error", "{:.3g}").replace("inf", "no bound")
    table.insert(1, "cases", list(frame.groupby("stage", sort=False).cases.sum()))
    table.insert(2, "budget", [f"{STAGES[name].factor:g}" for name in table.stage])
    return {"Worst error, in units of eps times the condition number": table}


def to_markdown(rows: Sequence[Row]) -> str:
    """Worst errors, reasons of budgets, and descriptions of families."""
    stages = list(dict.fromkeys(row["stage"] for row in rows))
    families = list(dict.fromkeys(row["family"] for row in rows))
    tables = tables_of(rows)
    tables["Budgets"] = pd.DataFrame({"stage": stages, "reason": [STAGES[name].reason for name in stages]})
    tables["Families"] = pd.DataFrame({"family": families, "inputs": [FAMILIES[f].says for f in families]})
    return document("Stress test", [f"{counts_of(rows)}."], tables)


def draw(rows: Sequence[Row]) -> Figure:
    """Picture of the largest error over budget of each stage and family, on a scale of 1e-6 to 1e3.

    Args:
        rows: cells of the matrix.
    """
    frame = pd.DataFrame(rows)
    frame = frame.assign(ratio=(frame.error.astype(float) / frame.budget).fillna(np.inf))
    ratios = frame.pivot_table(index="stage", columns="family", values="ratio", aggfunc="max", sort=False)
    values = np.log10(ratios.clip(1e-6, 1e3)).to_numpy()
    height, width = values.shape
    figure = Figure(figsize=(3.2 + 0.3 * width, 2.4 + 0.3 * height), layout="constrained")
    axes = figure.add_subplot(title=f"Worst error over budget: {counts_of(rows)}")
    norm = TwoSlopeNorm(vmin=-6, vcenter=0, vmax=3)
    picture = axes.imshow(np.ma.masked_invalid(values), cmap="RdYlGn_r", norm=norm, aspect="auto")
    for i, j in zip(*np.nonzero(values > 0), strict=True):
        axes.text(j, i, "✗", ha="center", va="center", color="white", fontweight="bold")
    axes.set_facecolor("0.93")  # families that a stage has no case of
    axes.set_xticks(range(width), ratios.columns.str.replace("_", " "), rotation=90, fontsize=8)
    axes.set_yticks(range(height), ratios.index, fontsize=8)
    bar = figure.colorbar(picture, ax=axes, fraction=0.02, pad=0.01, ticks=list(_TICKS))
    bar.ax.set_yticklabels(_TICKS.values())
    return figure


def write(directory: Path, rows: Sequence[Row], source: dict[str, Any]) -> Path:
    """Write ``stress.md``, ``stress.png`` and ``stress.json``.

    Args:
        directory: the run's.
        rows: cells of the matrix.
        source: provenance.

    Returns:
        Path of the JSON file.
    """
    write_text_atomically(directory / "stress.md", to_markdown(rows))
    save_figure(draw(rows), directory / "stress.png")
    content = {
        "cases": sum(row["cases"] for row in rows),
        "failures": sum(row["failures"] for row in rows),
        "cells": list(rows),
        "provenance": source,
    }
    text = json.dumps(content, indent=1, allow_nan=False)
    path = directory / "stress.json"
    write_text_atomically(path, text + "\n")
    return path
