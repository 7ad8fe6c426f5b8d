"""Cells of a table: means, deviations, the best value, and significant differences."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations, product
from typing import Any

import pandas as pd

from ghgs_lit.config.keys import OF_A_PLACE, OF_A_RUN, is_below
from ghgs_lit.config.nodes import PairedTest
from ghgs_lit.errors import InputError
from ghgs_lit.evaluation.tables.layouts import CELL, Table, data_title, metric_of
from ghgs_lit.evaluation.tables.records import TRAINING, person_of
from ghgs_lit.evaluation.tables.significance import Comparison, compare, holm, pool, smallest_difference
from ghgs_lit.evaluation.tables.variants import ABSENT, differing, differing_text


def fill(table: Table, figures: Sequence[Mapping[str, Any]]) -> None:
    """Fill the cells of a table.

    Args:
        table: With rows, lines, groups and metrics; gets ``cells`` and ``comparisons``.
        figures: Reported cells, each with ``line``, ``group``, ``metric`` and ``mean``.

    Raises:
        InputError: Runs with other numbers claim one cell and seed,
            or configurations in a cell differ.
    """
    values = _values(table)
    _refuse_rivals(table, values)
    # Runs with the same numbers count once.
    cell_and_seed = [*CELL, "seed"]
    values = values[values["source"] == values.groupby(cell_and_seed)["source"].transform("first")]
    seeds = values.groupby(cell_and_seed, sort=False)
    seeds = seeds.agg(mean=("value", "mean"), count=("count", "first"), run=("run", "first")).reset_index()
    means = {"mean": ("mean", "mean"), "deviation": ("mean", "std"), "seeds": ("seed", tuple)}
    cells = seeds.groupby(CELL).agg(**means, count=("count", "first"), runs=("run", " ".join))
    columns = list(product(range(len(table.groups)), table.metrics))
    every = [(line, *column) for line in range(len(table.lines)) for column in columns]
    cells = cells.reindex(pd.MultiIndex.from_tuples(every, names=CELL))
    reported = pd.DataFrame(figures, columns=[*CELL, "mean"]).set_index(CELL)
    table.cells = cells.assign(
        mean=cells["mean"].fillna(reported["mean"]), best=False, marked=False, test=None
    )
    table.cells["lacking"] = _lacking(table)
    for column in columns:
        _mark_best(table, column)
    if table.options.test.against != "none":
        _test(table, _by_person(values, table.options.unit), table.options.test)


def _line_of(table: Table) -> dict[Any, int]:
    """Numbers of the measured lines by variant."""
    return {line.variant: i for i, line in enumerate(table.lines) if line.variant.kind != "reported"}


def _values(table: Table) -> pd.DataFrame:
    """One row for each value: ``CELL``, ``seed``, ``source``, ``run``, ``subject``, ``count``,
    ``value``."""
    lines = _line_of(table)
    has_data = table.layout.columns == "data"
    groups = {(group.views, group.data): i for i, group in enumerate(table.groups)}
    rows = table.rows
    about = zip(rows["views"], rows["data"], strict=True)
    numbers = [groups.get((views, data_title(data) if has_data else None), -1) for views, data in about]
    rows = rows.assign(line=[lines[variant] for variant in rows["variant"]], group=numbers)
    rows = rows[rows["group"] >= 0]
    size = rows.groupby(["line", "group", "seed", "source"])["line"].transform("size")
    rows = rows.assign(count=rows.get("count", size).fillna(size), run=rows["run"].fillna(rows["source"]))
    facts = ["line", "group", "seed", "source", "run", "subject", "count"]
    return (
        rows.reindex(columns=[*facts, *table.metrics]).melt(facts, var_name="metric").dropna(subset="value")
    )


def _refuse_rivals(table: Table, values: pd.DataFrame) -> None:
    """Refuse several runs for one cell and seed, and runs of different configurations in one cell.

    Raises:
        InputError: Names the runs, and the keys in which they differ.
    """
    means = values.groupby([*CELL, "seed", "source"], sort=False)["value"].mean().reset_index("source")
    for (line, group, _, seed), part in means.groupby(level=[*CELL, "seed"], sort=False):
        if part["value"].nunique() > 1:
            raise _rivals(table, (line, group), list(part["source"]), f"one run for %s, seed {seed}")
    for cell, column in values.groupby(["line", "group"], sort=False)["source"]:
        sources = list(dict.fromkeys(column))
        for key, texts in _differing(table, sources).items():
            # Another version of the package has other keys; copies of the data lie in other folders.
            if len({*texts} - {ABSENT}) > 1 and not is_below(key, OF_A_PLACE):
                raise _rivals(table, cell, sources, "one configuration for %s")


def _differing(table: Table, sources: Sequence[str]) -> dict[str, list[str]]:
    """Keys in which the models of runs differ beyond what the runs of a row may."""
    return differing([table.configs[source] for source in sources if source in table.configs], OF_A_RUN)


def _rivals(table: Table, cell: tuple[int, int], sources: Sequence[str], expected: str) -> InputError:
    """The error that runs claim one cell, with the keys of ``by`` that give each a row."""
    variant = table.lines[cell[0]].variant
    row = f"ablation={variant.ablation}" if variant.ablation else variant.name
    expected %= f"{row}, {table.groups[cell[1]].views} views"
    keys = _differing(table, sources)
    cure = f"they differ in {differing_text(keys)}: by=[{','.join(keys)}] gives each a row"
    cure = cure if keys else "their configurations are equal"
    found = " and ".join(sources)
    return InputError(f"runs: expected {expected}; found {found}; {cure}; runs=[...] lists those to show")


def _lacking(table: Table) -> list[tuple[int, ...]]:
    """Seeds of planned runs without results that would fill each cell."""
    lines = _line_of(table)
    planned: dict[tuple[int, int], set[int]] = {}
    for run, (number, group) in product(table.planned, enumerate(table.groups)):
        fits_views = run.views is None or group.views in run.views
        if fits_views and group.data in (None, data_title(run.data)):
            planned.setdefault((lines[run.variant], number), set()).add(run.seed)
    lacking = []
    for (line, group, _), seeds in table.cells["seeds"].items():
        measured = seeds if isinstance(seeds, tuple) else ()
        lacking.append(tuple(sorted(planned.get((line, group), set()).difference(measured))))
    return lacking


def _competing(table: Table, column: tuple) -> pd.Series:
    """Means of a column by line, without baselines, some of which know the truth."""
    means = table.cells["mean"].xs(column, level=CELL[1:]).dropna()
    return means[[table.lines[i].variant.kind in ("model", "other") for i in means.index]]


def _mark_best(table: Table, column: tuple) -> None:
    """Mark the best means of a column, as printed. None is marked if all are equal, no direction is
    better, or the best leads by no more than the larger deviation over seeds of the best two."""
    metric = metric_of(column[1])
    means = _competing(table, column).round(metric.decimals)
    if means.nunique() < 2 or not metric.arrow:
        return
    means = means.sort_values(ascending=metric.arrow == "↓")
    deviations = table.cells["deviation"].xs(column, level=CELL[1:])[means.index[:2]]
    if abs(means.iloc[0] - means.iloc[1]) <= deviations.max():  # false if there is no deviation
        return
    for line in means.index[means == means.iloc[0]]:
        table.cells.loc[(line, *column), "best"] = True


def _by_person(values: pd.DataFrame, unit: re.Pattern[str] | None) -> pd.DataFrame:
    """Values that can be tested, by cell and seed (index) and by person (columns)."""
    values = values[values["subject"].notna() & ~values["metric"].isin(TRAINING)]
    values = values.assign(person=[person_of(subject, unit) for subject in values["subject"]])
    return values.groupby([*CELL, "seed", "person"])["value"].mean().unstack("person")


def _test(table: Table, people: pd.DataFrame, test: PairedTest) -> None:
    """Test each row against the reference of its column, corrected over all comparisons of the
    table. If the reference was chosen by its figures, every pair of rows of the column counts as a
    comparison."""
    tested: list[tuple[tuple | None, Comparison]] = []
    for column in product(range(len(table.groups)), table.tested):
        means = _competing(table, column)
        means = means[[(line, *column) in people.index.droplevel("seed") for line in means.index]]
        reference, chosen = _reference(table, means, column[1], test.against)
        if reference is None:
            continue
        rows = {line: people.loc[(line, *column)] for line in means.index}
        pooled = pool(list(rows.values()))
        for one, other in combinations(rows, 2):
            if reference in (one, other) or chosen:
                row, against = (other, one) if one == reference else (one, other)
                cell = (row, *column) if against == reference else None
                tested.append((cell, compare(rows[row], rows[against], test.alpha, pooled)))
    known = [comparison.p for _, comparison in tested if comparison.p is not None]
    table.comparisons = len(known)
    corrected = iter(holm(known))
    for cell, comparison in tested:
        if comparison.p is not None:
            smallest = smallest_difference(comparison, test.alpha, len(known))
            comparison = replace(comparison, corrected=next(corrected), smallest=smallest)
        if cell is not None:
            table.cells.at[cell, "test"] = comparison
            table.cells.at[cell, "marked"] = comparison.p is not None and comparison.corrected < test.alpha


def _reference(table: Table, means: pd.Series, metric: str, against: str) -> tuple[int | None, bool]:
    """Number of the reference row of a column, None without any, and whether it was chosen by its
    figures.

    Args:
        table: With lines.
        means: Means of the rows that compete, by number of the line.
        metric: Of the column.
        against: ``full``: the row of the whole method, where there is one;
            ``best``: the best of the column.
    """
    full = [i for i in means.index if table.lines[i].variant.ablation == "full"]
    if against == "full" and len(full) == 1:
        return full[0], False
    arrow = metric_of(metric).arrow
    if means.empty or not arrow:
        return None, False
    return (means.idxmin() if arrow == "↓" else means.idxmax()), True
