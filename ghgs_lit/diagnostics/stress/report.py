"""Report of the stress test as JSON, tables and a picture."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from ghgs_lit.diagnostics.output import document, save_figure, texts
from ghgs_lit.diagnostics.stress.measure import Row
from ghgs_lit.diagnostics.stress.stage import FAMILIES
from ghgs_lit.diagnostics.stress.stages import STAGES
from ghgs_lit.files import write_text_atomically

_WORST = ("stage", "family", "dtype", "error", "budget")  #: Columns of the worst cells


def frame_of(rows: Sequence[Row]) -> pd.DataFrame:
    """Rows with ``ratio``, the error over the budget; infinite for unbounded errors."""
    frame = pd.DataFrame(rows)
    return frame.assign(ratio=(frame.error.astype(float) / frame.budget).fillna(np.inf))


def worst_of(rows: Sequence[Row]) -> list[Row]:
    """Worst cell of each stage and dtype."""
    index = frame_of(rows).groupby(["stage", "dtype"], sort=False).ratio.idxmax()
    return [{name: rows[i][name] for name in _WORST} for i in index]


def summary(rows: Sequence[Row]) -> dict[str, Any]:
    """Numbers of cases and failures, the worst cell of each stage and dtype, and all cells."""
    totals = {name: sum(row[name] for row in rows) for name in ("cases", "failures")}
    return {**totals, "worst": worst_of(rows), "cells": list(rows)}


def bounded(error: float | None) -> str:
    """Text of an error, with three digits."""
    return "no bound" if error is None else f"{error:.3g}"


def to_markdown(rows: Sequence[Row]) -> str:
    """Worst errors, numbers of cases, budgets with reasons, and descriptions of families."""
    found, cases = summary(rows), _matrix(pd.DataFrame(rows), "cases", "sum")
    families, stages = list(cases.columns), [STAGES[name] for name in cases.index]
    worst = pd.DataFrame(found["worst"]).assign(error=[bounded(row["error"]) for row in found["worst"]])
    shown = dict.fromkeys(("stage", "dtype", "family", "error"), "{}") | {"budget": "{:g}"}
    budgets = [(stage.name, f"{stage.factor:g}", stage.reason) for stage in stages]
    counts = cases.map(lambda count: "" if pd.isna(count) else f"{count:.0f}")
    tables = {
        "Worst errors": texts(worst, {name: (name, form) for name, form in shown.items()}),
        "Cases": counts.assign(all=cases.sum(axis=1).map("{:.0f}".format)).reset_index(),
        "Budgets": pd.DataFrame(budgets, columns=["stage", "factor", "reason"]),
        "Families": pd.DataFrame({"family": families, "inputs": [FAMILIES[f].says for f in families]}),
    }
    notes = [
        f"{found['cases']} cases, {found['failures']} failures.",
        "Errors are in units of eps times the condition number of the case.",
    ]
    return document("Stress test", notes, tables)


def _matrix(frame: pd.DataFrame, values: str, how: str) -> pd.DataFrame:
    table = frame.pivot_table(index="stage", columns="family", values=values, aggfunc=how)
    stages, families = (
        [name for name in known if name in set(frame[key])]
        for key, known in (("stage", STAGES), ("family", FAMILIES))
    )
    return table.reindex(index=stages, columns=families)


def draw(rows: Sequence[Row]) -> Figure:
    """Picture of the largest error over budget of each stage and family."""
    ratios = _matrix(frame_of(rows), "ratio", "max")
    values = np.log10(ratios.clip(1e-6, 1e3)).to_numpy()
    height, width = values.shape
    figure = Figure(figsize=(3.2 + 0.3 * width, 2.4 + 0.3 * height), layout="constrained")
    axes = figure.add_subplot()
    colors = matplotlib.colormaps["RdYlGn_r"].copy()
    colors.set_bad("0.93")
    norm = matplotlib.colors.TwoSlopeNorm(vmin=-6, vcenter=0, vmax=3)
    picture = axes.imshow(np.ma.masked_invalid(values), cmap=colors, norm=norm, aspect="auto")
    for i, j in zip(*np.nonzero(values > 0), strict=True):
        axes.text(j, i, "✗", ha="center", va="center", color="white", fontweight="bold")
    axes.set_xticks(range(width), [f.replace("_", " ") for f in ratios.columns], rotation=90, fontsize=8)
    axes.set_yticks(range(height), ratios.index, fontsize=8)
    axes.set_xticks(np.arange(width + 1) - 0.5, minor=True)
    axes.set_yticks(np.arange(height + 1) - 0.5, minor=True)
    axes.grid(which="minor", color="white", linewidth=1)
    axes.tick_params(which="minor", length=0)
    found = summary(rows)
    axes.set_title(f"Worst error over budget: {found['cases']} cases, {found['failures']} failures")
    bar = figure.colorbar(picture, ax=axes, fraction=0.02, pad=0.01)
    bar.set_ticks([-6, -4, -2, 0, 3], labels=["1e-6 or less", "1e-4", "1 %", "budget", "1000 or more"])
    return figure


def write(directory: Path, rows: Sequence[Row], source: dict[str, Any]) -> Path:
    """Write ``stress.md``, ``stress.png`` and ``stress.json``; return the last one's path."""
    write_text_atomically(directory / "stress.md", to_markdown(rows))
    save_figure(draw(rows), directory / "stress.png")
    path = directory / "stress.json"
    text = json.dumps({**summary(rows), "provenance": source}, indent=1, allow_nan=False)
    write_text_atomically(path, text + "\n")
    return path
