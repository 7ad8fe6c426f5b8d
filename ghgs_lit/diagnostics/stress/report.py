"""The matrix as JSON, as tables and as a picture."""

import io
import json
import math
from collections import Counter, defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from ghgs_lit.diagnostics.stress.families import FAMILIES
from ghgs_lit.diagnostics.stress.run import Row
from ghgs_lit.diagnostics.stress.stages import STAGES
from ghgs_lit.files import write_atomically, write_text_atomically


def _ratio(row: Row) -> float:
    """Error over budget; infinite where the error has no bound."""
    return math.inf if row["error"] is None else row["error"] / row["budget"]


def summary(rows: Sequence[Row]) -> dict[str, Any]:
    """The numbers of cases and failures, the worst of each stage and dtype, and every cell."""
    worst: dict[tuple, Row] = {}
    for row in rows:
        place = (row["stage"], row["dtype"])
        if place not in worst or _ratio(row) > _ratio(worst[place]):
            worst[place] = row
    names = ("stage", "family", "dtype", "error", "budget")
    return {
        "cases": sum(row["cases"] for row in rows),
        "failures": sum(row["failures"] for row in rows),
        "worst": [{name: row[name] for name in names} for row in worst.values()],
        "cells": list(rows),
    }


def to_markdown(rows: Sequence[Row]) -> str:
    """The worst errors, the numbers of cases, budgets with their reasons, and why cells are empty."""
    stages, families = _axes(rows)
    found = summary(rows)
    lines = ["# Stress test", "", f"{found['cases']} cases, {found['failures']} failures.", ""]
    lines += ["## Worst errors", "", "In units of eps times the condition number of the case.", ""]
    lines += _table(("stage", "dtype", "family", "error", "budget"), [
        (r["stage"], r["dtype"], r["family"], "no bound" if r["error"] is None else f"{r['error']:.3g}",
         f"{r['budget']:g}")
        for r in found["worst"]
    ])  # fmt: skip
    counts = Counter()
    for row in rows:
        counts[row["stage"], row["family"]] += row["cases"]
    lines += ["", "## Cases", ""]
    lines += _table(("stage", *families, "all"), [
        (s, *(counts[s, f] or "" for f in families), sum(counts[s, f] for f in families))
        for s in stages
    ])  # fmt: skip
    lines += ["", "## Budgets", ""]
    lines += _table(
        ("stage", "factor", "reason"), [(s, f"{STAGES[s].factor:g}", STAGES[s].reason) for s in stages]
    )
    lines += ["", "## Empty cells", ""]
    for stage in stages:
        reasons = defaultdict(list)
        for family in families:
            if reason := STAGES[stage].missing(family):
                reasons[reason].append(family)
        said = "; ".join(f"{', '.join(names)}: {reason}" for reason, names in reasons.items())
        dtypes = f" Dtypes: {STAGES[stage].no_dtype}." if STAGES[stage].no_dtype else ""
        lines.append(f"- {stage}: {said or 'none'}.{dtypes}")
    lines += ["", "## Families", ""]
    lines += _table(("family", "inputs"), [(name, FAMILIES[name].says) for name in families])
    return "\n".join(lines) + "\n"


def _axes(rows: Sequence[Row]) -> tuple[list[str], list[str]]:
    stages, families = ({row[name] for row in rows} for name in ("stage", "family"))
    return [s for s in STAGES if s in stages], [f for f in FAMILIES if f in families]


def _table(header: Sequence[str], lines: Sequence[Sequence[object]]) -> list[str]:
    rows = [header, ["---"] * len(header), *lines]
    return [f"| {' | '.join(map(str, row))} |" for row in rows]


def draw(rows: Sequence[Row]) -> Figure:
    """The largest error over budget of each stage and family, over all dtypes."""
    stages, families = _axes(rows)
    values = np.full((len(stages), len(families)), np.nan)
    for row in rows:
        i, j = stages.index(row["stage"]), families.index(row["family"])
        level = float(np.clip(np.log10(max(_ratio(row), 1e-6)), -6, 3))
        values[i, j] = level if np.isnan(values[i, j]) else max(values[i, j], level)
    figure = Figure(figsize=(3.2 + 0.3 * len(families), 2.4 + 0.3 * len(stages)), layout="constrained")
    axes = figure.add_subplot()
    colors = matplotlib.colormaps["RdYlGn_r"].copy()
    colors.set_bad("0.93")
    norm = matplotlib.colors.TwoSlopeNorm(vmin=-6, vcenter=0, vmax=3)
    picture = axes.imshow(np.ma.masked_invalid(values), cmap=colors, norm=norm, aspect="auto")
    for i, j in zip(*np.nonzero(values > 0), strict=True):
        axes.text(j, i, "✗", ha="center", va="center", color="white", fontweight="bold")
    axes.set_xticks(range(len(families)), [f.replace("_", " ") for f in families], rotation=90, fontsize=8)
    axes.set_yticks(range(len(stages)), stages, fontsize=8)
    axes.set_xticks(np.arange(len(families) + 1) - 0.5, minor=True)
    axes.set_yticks(np.arange(len(stages) + 1) - 0.5, minor=True)
    axes.grid(which="minor", color="white", linewidth=1)
    axes.tick_params(which="minor", length=0)
    found = summary(rows)
    axes.set_title(f"Worst error over budget: {found['cases']} cases, {found['failures']} failures")
    bar = figure.colorbar(picture, ax=axes, fraction=0.02, pad=0.01)
    bar.set_ticks([-6, -4, -2, 0, 3], labels=["1e-6 or less", "1e-4", "1 %", "budget", "1000 or more"])
    return figure


def write(directory: Path, rows: Sequence[Row], source: dict[str, Any]) -> Path:
    """Write ``stress.md``, ``stress.png`` and ``stress.json``; returns the path of the last."""
    write_text_atomically(directory / "stress.md", to_markdown(rows))
    content = io.BytesIO()
    draw(rows).savefig(content, format="png", dpi=120)
    write_atomically(directory / "stress.png", lambda path: path.write_bytes(content.getvalue()))
    path = directory / "stress.json"
    text = json.dumps({**summary(rows), "provenance": source}, indent=1, allow_nan=False)
    write_text_atomically(path, text + "\n")
    return path
