"""The matrix as JSON and as tables."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from ghgs_lit.diagnostics.output import document, texts
from ghgs_lit.diagnostics.stress.families import FAMILIES
from ghgs_lit.diagnostics.stress.measure import Row
from ghgs_lit.diagnostics.stress.stages import STAGES
from ghgs_lit.files import write_text_atomically

#: Columns of the worst cells.
_WORST = ("stage", "family", "dtype", "error", "budget")


def frame_of(rows: Sequence[Row]) -> pd.DataFrame:
    """The rows with ``ratio``, the error over the budget, infinite where the error has no bound."""
    frame = pd.DataFrame(rows)
    return frame.assign(ratio=(frame.error.astype(float) / frame.budget).fillna(np.inf))


def worst_of(rows: Sequence[Row]) -> list[Row]:
    """The worst cell of each stage and dtype."""
    index = frame_of(rows).groupby(["stage", "dtype"], sort=False).ratio.idxmax()
    return [{name: rows[i][name] for name in _WORST} for i in index]


def summary(rows: Sequence[Row]) -> dict[str, Any]:
    """The numbers of cases and failures, the worst of each stage and dtype, and every cell."""
    totals = {name: sum(row[name] for row in rows) for name in ("cases", "failures")}
    return {**totals, "worst": worst_of(rows), "cells": list(rows)}


def bounded(error: float | None) -> str:
    """An error with three digits."""
    return "no bound" if error is None else f"{error:.3g}"


def to_markdown(rows: Sequence[Row]) -> str:
    """The worst errors, also by stage and family over the budget, budgets with reasons, and families."""
    found, ratios = summary(rows), _matrix(frame_of(rows), "ratio", "max")
    families, stages = list(ratios.columns), [STAGES[name] for name in ratios.index]
    worst = pd.DataFrame(found["worst"]).assign(error=[bounded(row["error"]) for row in found["worst"]])
    shown = dict.fromkeys(("stage", "dtype", "family", "error"), "{}") | {"budget": "{:g}"}
    budgets = [(stage.name, f"{stage.factor:g}", stage.reason) for stage in stages]
    tables = {
        "Worst errors": texts(worst, {name: (name, form) for name, form in shown.items()}),
        "Worst error over budget": ratios.map("{:.2g}".format).replace("nan", "").reset_index(),
        "Budgets": pd.DataFrame(budgets, columns=["stage", "factor", "reason"]),
        "Families": pd.DataFrame({"family": families, "inputs": [FAMILIES[f].says for f in families]}),
    }
    notes = [
        f"{found['cases']} cases, {found['failures']} failures.",
        "Errors are in units of eps times the condition number of the case.",
    ]
    return document("Stress test", notes, tables)


def _matrix(frame: pd.DataFrame, values: str, how: str) -> pd.DataFrame:
    """Values by stage and family, in their order."""
    table = frame.pivot_table(index="stage", columns="family", values=values, aggfunc=how)
    stages, families = (
        [name for name in known if name in set(frame[key])]
        for key, known in (("stage", STAGES), ("family", FAMILIES))
    )
    return table.reindex(index=stages, columns=families)


def write(directory: Path, rows: Sequence[Row], source: dict[str, Any]) -> Path:
    """Write ``stress.md`` and ``stress.json``; returns the path of the last."""
    write_text_atomically(directory / "stress.md", to_markdown(rows))
    path = directory / "stress.json"
    text = json.dumps({**summary(rows), "provenance": source}, indent=1, allow_nan=False)
    write_text_atomically(path, text + "\n")
    return path
