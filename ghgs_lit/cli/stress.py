"""``ghgs stress``: compare stages with float64 on adversarial inputs."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
from rich.progress import track

from ghgs_lit.cli.inputs import choices
from ghgs_lit.cli.reports import pivot, print_tables, publish
from ghgs_lit.cli.runtime import output_dir, write_config
from ghgs_lit.diagnostics.stress.families import FAMILIES
from ghgs_lit.diagnostics.stress.measure import Row, Stage, measure
from ghgs_lit.diagnostics.stress.whole import STAGES
from ghgs_lit.errors import require_choice
from ghgs_lit.runs.results import provenance

if TYPE_CHECKING:
    from ghgs_lit.cli.verbs import Stress

Task = tuple[Stage, str, int]  #: Stage, family and number of cases


def run(verb: "Stress") -> None:
    """Compare stages with float64 and write ``stress.md`` and ``stress.json``.

    Args:
        verb: the configuration of the run.

    Raises:
        InputError: there is no such stage.
        SystemExit: code 1: an error exceeds its budget.
    """
    directory = output_dir()
    write_config(verb, directory)
    tasks = track(tasks_of(verb.stages, verb.quick), "stages and families", transient=True)
    rows = [row for task in tasks for row in measure(*task)]
    cells = pd.DataFrame(rows)
    content = {"cases": int(cells.cases.sum()), "failures": int(cells.failures.sum()), "cells": rows}
    content["provenance"] = provenance(verb.plain, seed=0, verb="stress", choices=choices())
    tables = {"Worst error, in units of eps times the condition number": worst_errors(cells)}
    summary = "{cases} cases, {failures} failures".format_map(content)
    print_tables(tables)
    print(summary)
    budgets = {name: STAGES[name].reason for name in cells.stage.unique()}
    inputs = {name: FAMILIES[name].text for name in cells.family.unique()}
    tables["Budgets"] = pd.DataFrame(budgets.items(), columns=["stage", "reason"])
    tables["Families"] = pd.DataFrame(inputs.items(), columns=["family", "inputs"])
    failures = [failure(row) for row in rows if row["failures"]]
    publish(directory, "stress", ["Stress test", f"{summary}."], tables, content, failures)


def tasks_of(stages: Sequence[str] | None = None, quick: bool = False) -> list[Task]:
    """Tasks of the chosen stages, one for each family of inputs that applies to a stage.

    Args:
        stages: names; None: all.
        quick: few cases of each: one of a stage that is slow, three of another.

    Raises:
        InputError: an unknown name.
    """
    tasks = []
    for name in STAGES if stages is None else stages:
        require_choice("stages", name, tuple(STAGES))
        stage = STAGES[name]
        seeds = stage.seeds
        if quick:
            seeds = 1 if seeds < 25 else 3
        tasks += [(stage, family, seeds) for family in stage.families]
    return tasks


def worst_errors(cells: pd.DataFrame) -> pd.DataFrame:
    """Worst error of each stage and dtype, next to its cases and its budget."""
    cells = cells.assign(error=cells.error.astype(float).fillna(np.inf))
    worst = cells.groupby(["stage", "dtype"], sort=False).error.max().reset_index()
    table = pivot(worst, "stage", "dtype", "error", "{:.3g}").replace("inf", "no bound")
    table.insert(1, "cases", list(cells.groupby("stage", sort=False).cases.sum()))
    table.insert(2, "budget", [f"{STAGES[name].factor:g}" for name in table.stage])
    return table


def failure(row: Row) -> str:
    """A line about a cell with failures."""
    error = "no bound" if row["error"] is None else f"{row['error']:.3g}"
    found = f"{error} in {row['failures']} of {row['cases']} cases ({row['worst']})"
    place = f"{row['stage']}, {row['family']}, {row['dtype']}"
    return f"{place}: expected an error of at most {row['budget']:g}; found {found}"
