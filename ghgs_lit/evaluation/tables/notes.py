"""The caption of a table and the notes below it."""

from collections.abc import Iterable
from typing import Any

import pandas as pd

from ghgs_lit.evaluation.tables.layouts import Table, data_title, metric_of, paper
from ghgs_lit.evaluation.tables.significance import POWER
from ghgs_lit.evaluation.tables.variants import ablation_sets, describe, find_differences

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
#: Share of equal neighbours above which the ablation of 3D unprojection hardly changes the method.
_MOSTLY_SHARED = 0.8
_STEPS = "Rows were trained for different numbers of steps: `columns=[psnr,steps]` shows them."
_SEEDS = "Rows are of different seeds, which `table.csv` lists."
_PARTIAL = "(2/3): from 2 of 3 seeds; the others have no results yet."


def write_caption(table: Table) -> str:
    """Caption of a table in one line of Markdown: data, subjects, protocol, model and number of
    seeds."""
    first = table.rows.iloc[0]
    variant = first["variant"]
    names = " and ".join(f"`{name}`" for name in dict.fromkeys(table.rows["data"]))
    counts = " or ".join(map(str, sorted({int(count) for count in table.measured["count"]})))
    selection = f" that match `{table.options.subjects.pattern}`" if table.options.subjects else ""
    parts = [
        f"Data {names}",
        f"{counts or 'no'} subject{'s' * (counts != '1')} of `{first['split']}`{selection}",
        f"targets `{first['targets']}`",
        f"metrics `{first['protocol']}`",
    ]
    if table.is_ablation:
        parts += [f"model `{variant.model}`", f"encoder `{variant.encoder}`", *variant.titles]
    views = {group.views for group in table.groups}
    if table.layout.heading != "views" and len(views) == 1:
        parts.append(f"{views.pop()} input views")
    seeds = table.measured["seeds"].map(len)
    spread = lead = ""
    if seeds.max() > 1:
        spread = f" ± deviation over {_range(seeds)} seeds"
        lead = " where it leads by more than the deviation"
    return f"{', '.join(parts)}; mean over subjects{spread}, best of the measured methods in bold{lead}."


def _range(values: Iterable[Any]) -> str:
    values = sorted(values)
    return " to ".join(map(str, dict.fromkeys((values[0], values[-1]))))


def write_notes(table: Table) -> list[str]:
    """Notes below a table that affect its interpretation, as paragraphs of Markdown."""
    kinds = table.rows["variant"].map(lambda variant: variant.kind)
    ours = table.rows[kinds == "model"]
    others = table.rows[kinds == "other"]
    by_row = ours.groupby("variant", sort=False)
    shared = by_row["shared_neighbors"].mean().max() if "shared_neighbors" in ours else 0
    models = [line.variant for line in table.lines if line.variant.kind == "model"]
    applies = {
        FOOTNOTE: table.is_ablation,
        NO_SEMANTICS: table.is_ablation and not models[0].has_semantics,
        _FLIP: "flip" in table.metrics and "lpips" not in table.metrics,
        _TRAINED_VIEWS: len(table.groups) > 1 and table.rows["trained_views"].nunique() > 1,
        _MEANS: others["subject"].isna().any(),
        _NEIGHBORS: table.is_ablation and shared > _MOSTLY_SHARED,
        _STEPS: "steps" in ours and ours["steps"].nunique() > 1,
        _SEEDS: by_row["seed"].agg(lambda seeds: tuple(sorted(set(seeds)))).nunique() > 1,
        _PARTIAL: table.measured["lacking"].map(bool).any(),
    }
    notes = [note for note, holds in applies.items() if holds]
    sets = {}
    for variant, rows in by_row:
        if variant.is_own and (keys := ablation_sets(table.configs[rows["source"].iloc[-1]])):
            sets[variant.ablation] = keys
    for name, keys in sets.items():
        notes.append(f"`{name}`: {', '.join(f'`{key}={value}`' for key, value in keys.items())}.")
    if table.reported_on:
        notes.append(
            f"Reported: figures that {paper()['source']}, prints for {table.reported_on}, measured by its"
            " authors. They are not comparable with figures on other data, splits, views or protocols."
        )
    for variant, rows in others.groupby("variant", sort=False):
        notes.append(f"{variant.name}: {rows['origin'].iloc[0]}.")
    if table.left_out:
        notes.append(f"Further runs in the folder, of other data, views or ablations: {table.left_out}.")
    if table.planned:
        names = [
            f"{data_title(p.data)} {p.variant.model} {p.variant.ablation} seed {p.seed}"
            for p in table.planned
        ]
        notes.append(f"No results yet (in progress or cut off): {_first_of(list(dict.fromkeys(names)))}.")
    notes += _describe_test(table, [variant.ablation for variant in models])
    if keys := _find_differences(table, ours, {"checkpoint", *set().union(*sets.values())}):
        notes.append(f"Runs side by side differ also in {describe(keys)}.")
    states = sorted(table.rows["git"].dropna().unique())
    if len(states) > 1:
        notes.append(f"The runs are of {len(states)} states of the code: {', '.join(states)}.")
    return notes


def _first_of(names: list[str]) -> str:
    return "; ".join(names[:4]) + (f" and {len(names) - 4} more" if len(names) > 4 else "")


def _find_differences(table: Table, ours: pd.DataFrame, shown: set[str]) -> dict[str, list[str]]:
    """Keys in which runs of a row, or of all rows of ablations, differ, except for those in
    ``shown``."""
    groups: dict[tuple, list] = {}
    for source, rows in ours.groupby("source", sort=False):
        variant = rows["variant"].iloc[0]
        shown = shown.union(key for key, _ in variant.extra)
        row = (variant.model, variant.encoder, variant.ablation, rows["data"].iloc[0])
        groups.setdefault(() if table.is_ablation else row, []).append(table.configs[source])
    keys = {}
    for group in groups.values():
        keys |= find_differences(group)
    return {key: values for key, values in keys.items() if key not in shown}


def _describe_test(table: Table, ablations: list[str]) -> list[str]:
    """Meaning of the marks, and the smallest difference that the seeds and subjects could show."""
    tests = table.cells["test"].dropna()
    known = [test for test in tests if test.p is not None]
    if not known:
        lack = "subjects" if any(test.seeds > 1 for test in tests) else "seeds"
        return [f"No differences are marked: rows have fewer than two {lack} in common."] * (len(tests) > 0)
    is_full = table.options.test.against == "full" and ablations.count("full") == 1
    against = "the row of the whole method" if is_full else "its column's best row"
    sizes = f"{_range(t.seeds for t in known)} seeds and {_range(t.subjects for t in known)} subjects"
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
