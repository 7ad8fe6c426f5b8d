"""The caption of a table and the notes below it."""

from collections.abc import Iterable
from typing import Any

import pandas as pd

from ghgs_lit.evaluation.tables.layouts import Table, data_title, metric_of, paper
from ghgs_lit.evaluation.tables.significance import POWER
from ghgs_lit.evaluation.tables.variants import ablation_sets, differing, differing_text

MARK = "*"
FOOTNOTE = (
    "All four combinations are listed. The paper's Table 4 prints three and has (✗, ✓) among them,"
    " while its text says that semantic consistency alone is not included. Without 3D unprojection"
    " there are no token points: neighbours are then found on the image plane."
)
NO_SEMANTICS = "(a) features carry no semantics: this encoder was never trained for semantics."
_FLIP = (
    "FLIP replaces the paper's LPIPS, which at least one run could not compute: `ghgs evaluate`"
    " measures its checkpoint again where the extra `lpips` and its weights are installed."
)
_TRAINED_VIEWS = (
    "Each column shows the model that was trained with as many input views;"
    " `by=[views.training_counts]` gives each model a row."
)
_MEANS = "Rows of other methods without subjects are not tested and are means of all their subjects."
_NEIGHBORS = (
    "**The switch of 3D unprojection hardly switches**: most neighbours of a token are the same with and"
    " without it (`columns=[shared_neighbors]`), because recalibration.k is close to the number of tokens:"
    " give a share, such as 0.1."
)
#: Share of equal neighbours above which the ablation of 3D unprojection compares nearly
#: the same methods.
_MOSTLY_SHARED = 0.8
_STEPS = "Rows were trained for different numbers of steps: `columns=[psnr,steps]` shows them."
_SEEDS = "Rows are of different seeds, which `table.csv` lists."
_PARTIAL = "(2/3): from 2 of 3 seeds; the others have no results yet."


def write_caption(table: Table) -> str:
    """Caption of a table in one line: data, subjects, protocol, model and number of seeds.

    Args:
        table: With its cells.

    Returns:
        Text with Markdown.
    """
    first = table.rows.iloc[0]
    variant = first["variant"]
    names = " and ".join(f"`{name}`" for name in dict.fromkeys(table.rows["data"]))
    counts = " or ".join(map(str, sorted({int(count) for count in table.measured["count"]})))
    selection = table.options.subjects and f" that match `{table.options.subjects.pattern}`"
    parts = [
        f"Data {names}",
        f"{counts or 'no'} subject{'s' * (counts != '1')} of `{first['split']}`{selection or ''}",
        f"targets `{first['targets']}`",
        f"metrics `{first['protocol']}`",
    ]
    if table.layout.rows == "ablation":
        parts += [f"model `{variant.model}`", f"encoder `{variant.encoder}`", *variant.titles]
    views = {group.views for group in table.groups}
    if table.layout.heading != "views" and len(views) == 1:
        parts.append(f"{views.pop()} input views")
    seeds = table.measured["seeds"].map(len)
    best = "best of the measured methods in bold"
    if seeds.max() > 1:
        spread = f"mean over subjects ± deviation over {_range(seeds)} seeds"
        return f"{', '.join(parts)}; {spread}, {best} where it leads by more than the deviation."
    return f"{', '.join(parts)}; mean over subjects, {best}."


def _range(values: Iterable[Any]) -> str:
    values = list(values)
    return " to ".join(map(str, dict.fromkeys((min(values), max(values)))))


def write_notes(table: Table) -> list[str]:
    """Notes below a table that change how it is read.

    Args:
        table: With its cells.

    Returns:
        Paragraphs with Markdown.
    """
    is_ablation = table.layout.rows == "ablation"
    ours = table.rows[[variant.kind == "model" for variant in table.rows["variant"]]]
    others = table.rows[[variant.kind == "other" for variant in table.rows["variant"]]]
    rows = ours.groupby("variant", sort=False)
    shared = rows["shared_neighbors"].mean().max() if "shared_neighbors" in ours else 0
    applies = {
        FOOTNOTE: is_ablation,
        NO_SEMANTICS: is_ablation and not table.ours[0].has_semantics,
        _FLIP: "flip" in table.metrics and "lpips" not in table.metrics,
        _TRAINED_VIEWS: len(table.groups) > 1 and table.rows["trained_views"].nunique() > 1,
        _MEANS: others["subject"].isna().any(),
        _NEIGHBORS: is_ablation and shared > _MOSTLY_SHARED,
        _STEPS: "steps" in ours and ours["steps"].nunique() > 1,
        _SEEDS: rows["seed"].agg(lambda seeds: tuple(sorted(set(seeds)))).nunique() > 1,
        _PARTIAL: table.measured["lacking"].map(bool).any(),
    }
    notes = [note for note, holds in applies.items() if holds]
    sets = own_ablations(table)
    for name, values in sets.items():
        notes.append(f"`{name}`: {', '.join(f'`{key}={value}`' for key, value in values.items())}.")
    if table.reported_on:
        notes.append(
            f"Reported: figures that {paper()['source']}, prints for {table.reported_on}, measured by its"
            " authors. They are not comparable with figures on other data, splits, views or protocols."
        )
    sources = others.drop_duplicates("variant") if len(others) else others
    notes += [f"{row.variant.name}: {row.said}." for row in sources.itertuples()]
    if table.others:
        notes.append(f"Further runs in the folder, of other data, views or ablations: {table.others}.")
    names = (
        f"{data_title(p.data)} {p.variant.model} {p.variant.ablation} seed {p.seed}" for p in table.planned
    )
    if unfinished := list(dict.fromkeys(names)):
        more = f" and {len(unfinished) - 4} more" if len(unfinished) > 4 else ""
        notes.append(f"No results yet (in progress or cut off): {'; '.join(unfinished[:4])}{more}.")
    notes += _about_test(table)
    if keys := _differing(table, ours, set().union(*sets.values())):
        notes.append(f"Runs side by side differ also in {differing_text(keys)}.")
    states = sorted(table.rows["git"].dropna().unique())
    if len(states) > 1:
        notes.append(f"The runs are of {len(states)} states of the code: {', '.join(states)}.")
    return notes


def own_ablations(table: Table) -> dict[str, dict[str, Any]]:
    """What a user's own ablations set.

    Args:
        table: With measurements and configurations.

    Returns:
        By name of the row the dotted keys that the ablation sets, with their values.
    """
    own: dict[str, dict[str, Any]] = {}
    for source, variant in zip(table.rows["source"], table.rows["variant"], strict=True):
        if variant.is_own and (sets := ablation_sets(table.configs[source])):
            own[variant.ablation] = sets
    return own


def _differing(table: Table, ours: pd.DataFrame, shown: set[str]) -> dict[str, list[str]]:
    """Keys in which runs of a row, or of all rows of ablations, differ beside those that are shown."""
    groups: dict[tuple, list] = {}
    for source, rows in ours.groupby("source", sort=False):
        variant = rows["variant"].iloc[0]
        row = (variant.model, variant.encoder, variant.ablation, rows["data"].iloc[0])
        groups.setdefault(() if table.layout.rows == "ablation" else row, []).append(table.configs[source])
    keys = {}
    for group in groups.values():
        keys |= differing(group)
    shown = {"checkpoint", *shown, *(key for variant in table.ours for key, _ in variant.extra)}
    return {key: values for key, values in keys.items() if key not in shown}


def _about_test(table: Table) -> list[str]:
    """What the marks mean, and the smallest difference that the seeds and subjects could show."""
    tests = table.cells["test"].dropna()
    known = [test for test in tests if test.p is not None]
    if not known:
        lack = "subjects" if tests.map(lambda test: test.seeds > 1).any() else "seeds"
        return [f"No differences are marked: rows have fewer than two {lack} in common."] * (len(tests) > 0)
    full = [variant for variant in table.ours if variant.ablation == "full"]
    is_full = table.options.test.against == "full" and len(full) == 1
    against = "the row of the whole method" if is_full else "its column's best row"
    sizes = (
        f"{_range(test.seeds for test in known)} seeds and {_range(test.subjects for test in known)} subjects"
    )
    alpha = table.options.test.alpha
    could_show = []
    for metric in table.tested:
        smallest = tests.xs(metric, level="metric").map(lambda test: test.smallest or 0).max()
        could_show.append(f"{metric_of(metric).title} {smallest:.{metric_of(metric).decimals}f}")
    return [
        f"{MARK} differs beyond chance from {against} (p < {alpha:g} after Holm's correction over"
        f" {table.comparisons} comparisons of {sizes}). In brackets the {100 * (1 - alpha):g} % interval of"
        " the difference. Tested columns, each with the difference that is found with"
        f" {100 * POWER:g} % power: {', '.join(could_show)}."
    ]
