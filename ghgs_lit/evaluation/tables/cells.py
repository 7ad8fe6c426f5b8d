"""Cells of a table: means, deviations, the best value, and significant differences."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations, product

import pandas as pd

from ghgs_lit.config.keys import OF_A_PLACE, OF_A_RUN, is_below
from ghgs_lit.errors import InputError
from ghgs_lit.evaluation.tables.layouts import CELL, Table, data_title, metric_of, paper
from ghgs_lit.evaluation.tables.runs import TRAINING
from ghgs_lit.evaluation.tables.significance import (
    ALPHA,
    Comparison,
    compare,
    holm,
    pool,
    smallest_difference,
)
from ghgs_lit.evaluation.tables.variants import ABSENT, describe, find_differences


def fill(table: Table) -> None:
    """Fill the cells of a table.

    Args:
        table: With rows, lines, groups and metrics; ``cells`` and ``comparisons`` are set.

    Raises:
        InputError: Runs with different numbers have the same cell and seed, or configurations in a
            cell differ.
    """
    values = _values(table)
    _reject_rivals(table, values)
    # Runs with the same numbers count once.
    cell_and_seed = [*CELL, "seed"]
    values = values[values["source"] == values.groupby(cell_and_seed)["source"].transform("first")]
    seeds = values.groupby(cell_and_seed, sort=False)
    seeds = seeds.agg(mean=("value", "mean"), count=("count", "first"), run=("run", "first")).reset_index()
    means = {"mean": ("mean", "mean"), "deviation": ("mean", "std"), "seeds": ("seed", tuple)}
    cells = seeds.groupby(CELL).agg(**means, count=("count", "first"), runs=("run", " ".join))
    shape = (range(len(table.lines)), range(len(table.groups)), table.metrics)
    cells = cells.reindex(pd.MultiIndex.from_product(shape, names=CELL))
    cells["mean"] = cells["mean"].fillna(_reported_figures(table))
    cells["lacking"] = _missing_seeds(table, cells["seeds"])
    table.cells = cells.assign(best=False, marked=False, test=None)
    # Without baselines: some of them read the ground truth.
    competing = [i for i, line in enumerate(table.lines) if line.variant.kind in ("model", "other")]
    competing = cells["mean"].dropna().loc[lambda means: means.index.isin(competing, level="line")]
    for column, means in competing.groupby(CELL[1:]):
        _mark_best(table, means.round(metric_of(column[1]).decimals), metric_of(column[1]).arrow)
    _test(table, _values_by_person(table, values), competing)


def _values(table: Table) -> pd.DataFrame:
    """Long form, one row per value: ``CELL``, ``seed``, ``source``, ``run``, ``subject``, ``count``,
    ``value``."""
    rows = table.rows
    lines = {line.variant: i for i, line in enumerate(table.lines) if line.variant.kind != "reported"}
    groups = {(group.views, group.data): i for i, group in enumerate(table.groups)}
    titles = rows["data"].map(data_title) if table.layout.columns == "data" else [None] * len(rows)
    numbers = [groups.get(key, -1) for key in zip(rows["views"], titles, strict=True)]
    rows = rows.assign(line=[lines[variant] for variant in rows["variant"]], group=numbers)
    rows = rows[rows["group"] >= 0]
    size = rows.groupby(["line", "group", "seed", "source"])["line"].transform("size")
    rows = rows.assign(count=rows.get("count", size).fillna(size), run=rows["run"].fillna(rows["source"]))
    facts = ["line", "group", "seed", "source", "run", "subject", "count"]
    rows = rows.reindex(columns=[*facts, *table.metrics])
    return rows.melt(facts, var_name="metric").dropna(subset="value")


def _reject_rivals(table: Table, values: pd.DataFrame) -> None:
    """Reject different numbers for one cell and seed, and different configurations in one cell."""
    means = values.groupby([*CELL, "seed", "source"], sort=False)["value"].mean().reset_index("source")
    for (line, group, _, seed), part in means.groupby(level=[*CELL, "seed"], sort=False):
        if part["value"].nunique() > 1:
            raise _rival_error(table, (line, group), list(part["source"]), f"one run for %s, seed {seed}")
    for cell, column in values.groupby(["line", "group"], sort=False)["source"]:
        sources = list(dict.fromkeys(column))
        for key, texts in _find_differences(table, sources).items():
            # Keys depend on the package's version, folders on the machine.
            if len({*texts} - {ABSENT}) > 1 and not is_below(key, OF_A_PLACE):
                raise _rival_error(table, cell, sources, "one configuration for %s")


def _find_differences(table: Table, sources: Sequence[str]) -> dict[str, list[str]]:
    """Keys beyond ``OF_A_RUN`` in which configurations of the runs' models differ."""
    return find_differences(
        [table.configs[source] for source in sources if source in table.configs], OF_A_RUN
    )


def _rival_error(table: Table, cell: tuple[int, int], sources: Sequence[str], expected: str) -> InputError:
    """The error for several runs in one cell, with the keys of ``by`` that give each its own row."""
    variant = table.lines[cell[0]].variant
    row = f"ablation={variant.ablation}" if variant.ablation else variant.name
    keys = _find_differences(table, sources)
    cure = f"they differ in {describe(keys)}: by=[{','.join(keys)}] gives each a row"
    return InputError(
        f"runs: expected {expected % f'{row}, {table.groups[cell[1]].views} views'}; found"
        f" {' and '.join(sources)}; {cure if keys else 'their configurations are equal'};"
        " runs=[...] lists those to show"
    )


def _reported_figures(table: Table) -> pd.Series:
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


def _missing_seeds(table: Table, measured: pd.Series) -> list[tuple[int, ...]]:
    """Seeds of planned runs without results that would fill each cell."""
    planned = defaultdict(set)
    for run, (number, group) in product(table.planned, enumerate(table.groups)):
        if group.views in run.views and group.data in (None, data_title(run.data)):
            planned[run.variant, number].add(run.seed)
    lacking = []
    for (line, group, _), seeds in measured.items():
        known = seeds if isinstance(seeds, tuple) else ()
        lacking.append(tuple(sorted(planned[table.lines[line].variant, group].difference(known))))
    return lacking


def _mark_best(table: Table, means: pd.Series, arrow: str) -> None:
    """Mark the best means of a column, as printed.

    None is marked if all are equal, if the metric has no better direction, or if the best leads by no
    more than the larger deviation over seeds of the best two.
    """
    if means.nunique() < 2 or not arrow:
        return
    means = means.sort_values(ascending=arrow == "↓")
    deviations = table.cells["deviation"][means.index[:2]]
    if not abs(means.iloc[0] - means.iloc[1]) <= deviations.max():  # false if there is no deviation
        table.cells.loc[means.index[means == means.iloc[0]], "best"] = True


def _values_by_person(table: Table, values: pd.DataFrame) -> pd.DataFrame:
    """Values that can be tested, by cell and seed (index) and by person (columns)."""
    values = values[values["subject"].notna() & ~values["metric"].isin(TRAINING)]
    person = values["subject"]
    if table.unit:
        matches = [table.unit.fullmatch(name) for name in person]
        person = [match[1] if match else name for match, name in zip(matches, person, strict=True)]
    values = values.assign(person=person)
    return values.groupby([*CELL, "seed", "person"])["value"].mean().unstack("person")


def _test(table: Table, people: pd.DataFrame, competing: pd.Series) -> None:
    """Test each row against the reference of its column in the first metric, corrected over all
    comparisons of the table.

    The reference is the row of the whole method, if there is exactly one; else the best, and every
    pair of rows of the column counts as a comparison, since its figures chose it.
    """
    competing = competing[competing.index.isin(people.index.droplevel("seed"))]
    tested = next((name for name in table.metrics if name not in TRAINING), "")
    arrow = metric_of(tested).arrow
    tests: dict[tuple, Comparison] = {}
    unprinted = []
    for group in range(len(table.groups)):
        means = competing[[cell[1:] == (group, tested) for cell in competing.index]]
        full = [cell for cell in means.index if table.lines[cell[0]].variant.ablation == "full"]
        is_chosen = len(full) != 1
        if means.empty or (is_chosen and not arrow):
            continue
        best = means.idxmin() if arrow == "↓" else means.idxmax()
        reference = best if is_chosen else full[0]
        rows = {cell: people.loc[cell] for cell in means.index}
        pooled = pool(list(rows.values()))
        rest = [cell for cell in rows if cell != reference]
        for cell in rest:
            tests[cell] = compare(rows[cell], rows[reference], pooled)
        for pair in combinations(rest, 2) if is_chosen else ():
            unprinted.append(compare(*(rows[cell] for cell in pair), pooled).p)
    known = [cell for cell, test in tests.items() if test.p is not None]
    corrected = holm([tests[cell].p for cell in known] + [p for p in unprinted if p is not None])
    table.comparisons = len(corrected)
    for cell, p in zip(known, corrected, strict=False):
        smallest = smallest_difference(tests[cell], len(corrected))
        tests[cell] = replace(tests[cell], corrected=p, smallest=smallest)
        table.cells.at[cell, "marked"] = p < ALPHA
    for cell, test in tests.items():
        table.cells.at[cell, "test"] = test
