"""Cells of a table: means, deviations, the best value, and significant differences."""

import re
from itertools import combinations

import pandas as pd

from ghgs_lit.config.keys import OF_A_PLACE, OF_A_RUN, is_below
from ghgs_lit.errors import InputError
from ghgs_lit.evaluation.tables.layouts import CELL, Table, data_title, metric_of, paper
from ghgs_lit.evaluation.tables.runs import ABSENT, TRAINING, describe, find_differences
from ghgs_lit.evaluation.tables.significance import (
    ALPHA,
    Comparison,
    compare,
    holm,
    pool,
    smallest_difference,
)


def fill(table: Table, unit: str | None) -> None:
    """Fill the cells of a table.

    Args:
        table: ``cells`` and ``comparisons`` are set.
        unit: Regular expression whose first group is the person, if subjects are frames of people.

    Raises:
        InputError: Runs with different numbers have the same cell and seed, configurations in a cell
            differ, or ``unit`` is no such expression.
    """
    values = _find_values(table)
    _reject_rivals(table, values)
    # Runs with the same numbers count once.
    values = values[values["source"] == values.groupby([*CELL, "seed"])["source"].transform("first")]
    table.cells = _make_cells(table, values)
    models = [number for number, line in enumerate(table.lines) if line.variant.kind == "model"]
    _mark_best(table.cells, models)
    _test(table, values[values["line"].isin(models)], unit)


def _place(table: Table, rows: pd.DataFrame) -> pd.DataFrame:
    """Rows with the numbers of their ``line`` and ``group``, without those that are in no group."""
    lines = {line.variant: i for i, line in enumerate(table.lines) if line.variant.kind != "reported"}
    groups = {(group.views, group.data): i for i, group in enumerate(table.groups)}
    titles = rows["data"].map(data_title) if table.layout.columns == "data" else [None] * len(rows)
    numbers = [groups.get(key, -1) for key in zip(rows["views"], titles, strict=True)]
    rows = rows.assign(line=[lines[variant] for variant in rows["variant"]], group=numbers)
    return rows[rows["group"] >= 0]


def _find_values(table: Table) -> pd.DataFrame:
    """Long form, one row per value: ``CELL``, ``seed``, ``source``, ``run``, ``subject``, ``count`` of
    subjects, ``value``."""
    rows = _place(table, table.rows)
    count = rows.groupby(["line", "group", "seed", "source"])["line"].transform("size")
    facts = ["line", "group", "seed", "source", "run", "subject", "count"]
    rows = rows.assign(count=count).reindex(columns=[*facts, *table.metrics])
    return rows.melt(facts, var_name="metric").dropna(subset="value")


def _reject_rivals(table: Table, values: pd.DataFrame) -> None:
    """Reject different numbers for one cell and seed, and different configurations in one cell."""
    for (line, group), part in values.groupby(["line", "group"], sort=False):
        sources = part["source"].unique()
        means = part.groupby(["metric", "seed", "source"])["value"].mean()
        is_rival = (means.groupby(["metric", "seed"]).nunique() > 1).any()
        variant = table.lines[line].variant
        models = [table.configs[source] for source in sources if variant.kind == "model"]
        keys = find_differences(models, OF_A_RUN)
        # Which keys exist depends on the package's version, folders on the machine.
        keys = {key: texts for key, texts in keys.items() if len({*texts} - {ABSENT}) > 1}
        is_rival |= any(not is_below(key, OF_A_PLACE) for key in keys)
        if is_rival:
            row = f"ablation={variant.ablation}" if variant.ablation else variant.name
            cure = f"they differ in {describe(keys)}: by=[{','.join(keys)}] gives each a row"
            raise InputError(
                f"runs: expected one configuration, and one run a seed, for {row},"
                f" {table.groups[group].views} views; found {' and '.join(sources)};"
                f" {cure if keys else 'their configurations are equal'}; runs=[...] lists those to show"
            )


def _make_cells(table: Table, values: pd.DataFrame) -> pd.DataFrame:
    """Cells without marks and tests."""
    seeds = values.groupby([*CELL, "seed"], sort=False)
    seeds = seeds.agg(mean=("value", "mean"), count=("count", "first"), run=("run", "first")).reset_index()
    means = {"mean": ("mean", "mean"), "deviation": ("mean", "std"), "seeds": ("seed", tuple)}
    cells = seeds.groupby(CELL).agg(**means, count=("count", "first"), runs=("run", " ".join))
    shape = (range(len(table.lines)), range(len(table.groups)), table.metrics)
    cells = cells.reindex(pd.MultiIndex.from_product(shape, names=CELL))
    cells["mean"] = cells["mean"].fillna(_find_reported_figures(table))
    planned = _place(table, table.planned).groupby(["line", "group"])["seed"].agg(set)
    lacking = []
    for (line, group, _), seeds in cells["seeds"].items():
        known = seeds if isinstance(seeds, tuple) else ()
        lacking.append(tuple(sorted(planned.get((line, group), set()).difference(known))))
    return cells.assign(lacking=lacking, best=False)


def _find_reported_figures(table: Table) -> pd.Series:
    """The paper's figures by ``CELL``."""
    figures = {}
    for number, line in enumerate(table.lines):
        if line.variant.kind != "reported":
            continue
        row = paper()["tables"][table.layout.name]["rows"][line.variant.name]
        by_group = {data_title(key) if isinstance(key, str) else key: values for key, values in row.items()}
        for i, group in enumerate(table.groups):
            # The paper does not report the number of views of its Table 1.
            values = by_group.get(group.data or group.views, [])
            figures |= {(number, i, name): x for name, x in zip(paper()["metrics"], values, strict=False)}
    return pd.Series(figures, dtype=float)


def _mark_best(cells: pd.DataFrame, models: list[int]) -> None:
    """Mark the best means of each column, as printed, among models: some baselines read the truth.

    None is marked if all are equal, if the metric has no better direction, or if the best leads by no
    more than the larger deviation over seeds of the best two.
    """
    for (_, name), column in cells.loc[models].groupby(["group", "metric"]):
        _, decimals, arrow = metric_of(name)
        means = column["mean"].dropna().round(decimals).sort_values(ascending=arrow == "↓")
        if means.nunique() < 2 or not arrow:
            continue
        deviations = column["deviation"][means.index[:2]]
        if not abs(means.iloc[0] - means.iloc[1]) <= deviations.max():  # false if there is no deviation
            cells.loc[means.index[means == means.iloc[0]], "best"] = True


def _test(table: Table, values: pd.DataFrame, unit: str | None) -> None:
    """Test each model against the reference of its column in the first metric, corrected over all
    comparisons of the table.

    The reference is the row of the whole method, if there is exactly one; else the best, and every
    pair of rows of the column counts as a comparison, since its figures chose it.
    """
    tested = next((name for name in table.metrics if name not in TRAINING), "")
    arrow = metric_of(tested).arrow
    values = values[values["metric"] == tested]
    values = values.assign(person=_find_persons(values["subject"], unit))
    tests: dict[tuple, Comparison] = {}
    unprinted = []
    for group, column in values.groupby("group"):
        people = column.groupby(["line", "seed", "person"])["value"].mean().unstack("person")
        rows = {line: row.droplevel("line") for line, row in people.groupby("line")}
        full = [line for line in rows if table.lines[line].variant.ablation == "full"]
        is_chosen = len(full) != 1
        if is_chosen and not arrow:
            continue
        means = pd.Series({line: table.cells["mean"][line, group, tested] for line in rows})
        best = means.idxmin() if arrow == "↓" else means.idxmax()
        reference = best if is_chosen else full[0]
        pooled = pool(list(rows.values()))
        rest = [line for line in rows if line != reference]
        for line in rest:
            tests[line, group, tested] = compare(rows[line], rows[reference], pooled)
        for one, other in combinations(rest, 2) if is_chosen else ():
            unprinted.append(compare(rows[one], rows[other], pooled).p)
    index = pd.MultiIndex.from_tuples(tests, names=CELL)
    frame = pd.DataFrame(list(tests.values()), index, Comparison._fields)
    corrected = holm([*frame["p"], *unprinted])
    table.comparisons = int(corrected.count())
    frame["p_holm"] = corrected[: len(frame)].to_numpy()
    frame["smallest"] = [smallest_difference(test, table.comparisons) for test in tests.values()]
    table.cells = table.cells.join(frame.add_prefix("test_"))
    table.cells["marked"] = table.cells["test_p_holm"] < ALPHA


def _find_persons(subjects: pd.Series, unit: str | None) -> pd.Series:
    """The person of each subject."""
    if unit is None:
        return subjects
    try:
        persons = subjects.str.extract(f"^(?:{unit})$")[0]
    except (re.error, ValueError) as error:
        raise InputError(f"unit: expected a regular expression with a group; found {error}") from None
    return persons.fillna(subjects)
