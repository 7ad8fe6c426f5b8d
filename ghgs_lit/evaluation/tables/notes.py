"""The caption of a table and the notes below it."""

from typing import Any

import pandas as pd

from ghgs_lit.evaluation.tables.differences import differing, differing_text
from ghgs_lit.evaluation.tables.layouts import Table, data_title, decimals, reported_source, title
from ghgs_lit.evaluation.tables.significance import POWER, RATIO
from ghgs_lit.evaluation.tables.variants import ablation_sets

FOOTNOTE = (
    "All four combinations are listed. The paper's Table 4 prints three and has (✗, ✓) among them,"
    " while its text says that semantic consistency alone is not included. Without 3D unprojection"
    " there are no token points: neighbours are then found on the image plane."
)
NO_SEMANTICS = "features carry no semantics: this encoder was never trained for semantics"
MARK = "*"
#: Share of equal neighbours above which the ablation of 3D unprojection compares nearly
#: the same methods.
MOSTLY_SHARED = 0.8


def write_caption(table: Table) -> str:
    """Caption of a table in one line: data, subjects, protocol, model and number of seeds.

    Args:
        table: With its cells.

    Returns:
        Text with Markdown.
    """
    first = table.rows.iloc[0]
    names = dict.fromkeys(table.rows["data"])
    measured = table.measured
    counts = sorted({int(count) for count in measured["count"].dropna()})
    seeds = [len(seeds) for seeds in measured["seeds"]]
    subjects = f"{' or '.join(map(str, counts)) or 'no'} subject{'s' * (counts != [1])} of `{first['split']}`"
    if table.options.subjects is not None:
        subjects += f" whose name{'s match' if counts != [1] else ' matches'} {_selection(table)}"
    parts = [
        f"Data {' and '.join(f'`{name}`' for name in names)}",
        subjects,
        f"targets `{first['targets']}`",
        f"metrics `{first['protocol']}`",
    ]
    if table.layout.rows == "ablation":
        parts += [f"model `{first['variant'].model}`", f"encoder `{first['variant'].encoder}`"]
        parts += first["variant"].titles
    views = {group.views for group in table.groups}
    if table.layout.heading != "views" and len(views) == 1:
        parts.append(f"{views.pop()} input views")
    has_several = max(seeds, default=0) > 1
    spread = f" ± deviation over {_range(seeds)} seeds" if has_several else ""
    clear = " where it leads by more than the deviation" if has_several else ""
    return f"{', '.join(parts)}; mean over subjects{spread}, best of the measured methods in bold{clear}."


def _selection(table: Table) -> str:
    """The regular expression of the subjects that are shown, in Markdown."""
    return f"`{table.options.subjects.pattern}`"


def write_notes(table: Table) -> list[str]:
    """Notes below a table: what its rows are, where figures come from, what was tested, and what
    runs differ in.

    Args:
        table: With its cells.

    Returns:
        Paragraphs with Markdown.
    """
    notes: list[str] = []
    if table.layout.rows == "ablation":
        notes.append(FOOTNOTE)
        if not table.ours[0].variant.has_semantics:
            notes.append(f"(a) {NO_SEMANTICS}.")
    for name, sets in own_ablations(table).items():
        notes.append(f"`{name}`: {', '.join(f'`{key}={value}`' for key, value in sets.items())}.")
    if "flip" in table.metrics and "lpips" not in table.metrics:
        notes.append(
            "FLIP replaces the paper's LPIPS, which at least one run could not compute: `ghgs evaluate`"
            " measures its checkpoint again where the extra `lpips` and its weights are installed."
        )
    if table.reported_on:
        notes.append(
            f"Reported: figures that {reported_source()}, prints for {table.reported_on}, measured"
            " by its authors on their data, split and views. They were not measured here, and are"
            " not comparable with figures on other data or protocols."
        )
    if len(table.groups) > 1 and table.rows["trained_views"].nunique() > 1:
        notes.append(
            "Each column shows the model that was trained with as many input views;"
            " `by=[views.training_counts]` gives each model a row."
        )
    if table.others:
        runs = "runs" if table.others > 1 else "run"
        notes.append(f"{table.others} further {runs} in the folder: of other data, views or ablations.")
    notes += _about_others(table)
    notes += _about_test(table)
    return notes + _about_neighbors(table) + _about_training(table) + _about_runs(table)


def own_ablations(table: Table) -> dict[str, dict[str, Any]]:
    """What a user's own ablations set.

    Args:
        table: With measurements and configurations.

    Returns:
        By name of the row the dotted keys that the ablation sets, with their values.
    """
    own: dict[str, dict[str, Any]] = {}
    for source, variant in _of(table.rows, "model")[["source", "variant"]].drop_duplicates().values:
        sets = ablation_sets(table.configs[source])
        if variant.is_own and sets:
            own[variant.ablation] = sets
    return own


def _of(rows: pd.DataFrame, kind: str) -> pd.DataFrame:
    return rows[[variant.kind == kind for variant in rows["variant"]]]


def _about_others(table: Table) -> list[str]:
    notes = []
    ours = set(_of(table.rows, "model").groupby(["source", "views"]).size())
    for name, rows in _of(table.rows, "other").groupby("variant", sort=False):
        untested = "" if rows["subject"].notna().all() else "; means only where untested"
        if untested and table.options.subjects is not None:
            untested += f", of all its subjects, not of {_selection(table)} alone"
        means = rows["count"].dropna()
        subjects = rows[rows["subject"].notna()].groupby(["data", "views", "seed"]).size()
        counts = sorted({int(count) for count in (*means, *subjects)} - ours)
        fewer = f"; of {' or '.join(map(str, counts))} subjects" if counts else ""
        notes.append(f"{name.name}: {rows['said'].iloc[0]}{untested}{fewer}.")
    return notes


def _range(counts: list[int]) -> str:
    return " to ".join(map(str, dict.fromkeys((min(counts), max(counts)))))


def _about_test(table: Table) -> list[str]:
    tests = [comparison for comparison in table.cells["test"] if comparison is not None]
    if not tests:
        return []
    known = [comparison for comparison in tests if comparison.p is not None]
    if not known:
        if max(comparison.seeds for comparison in tests) < 2:
            why = "rows have fewer than two seeds in common, and one seed cannot tell a method from its luck"
        else:
            why = "rows have fewer than two subjects in common"
        return [f"No differences are marked: {why}."]
    against = "its column's best row"
    test = table.options.test
    if test.against == "full":
        full = [line for line in table.ours if line.variant.ablation == "full"]
        against = "the row of the whole method" if len(full) == 1 else against
    seeds = [c.seeds for c in known]
    subjects = [c.subjects for c in known]
    names = " or ".join(map(title, table.tested))
    sizes = f"{_range(seeds)} seeds and {_range(subjects)} subjects"
    comparisons = f"{table.comparisons} comparison{'s' if table.comparisons > 1 else ''}"
    others = "; other metrics are not tested" if len(table.tested) < len(table.metrics) else ""
    shown = _could_show(table)
    could_show = [f"{sizes} could have shown {'; '.join(shown)} (with {100 * POWER:g} % power)."]
    return [
        f"{MARK} {names} differs beyond chance from {against}: two-sided t test over {sizes} together, the"
        f" variance over seeds pooled over rows, whose deviations may differ by a factor of {RATIO:g}, Holm's"
        f" correction over the {comparisons} of this table, p < {test.alpha:g}{others}."
        f" In brackets the {100 * (1 - test.alpha):g} % interval of the difference, each alone.",
        *(could_show if shown else ()),
    ]


def _could_show(table: Table) -> list[str]:
    """The smallest differences that comparisons find, by metric,
    such as ``0.21 to 0.25 dB of PSNR``."""
    texts = []
    for metric in table.tested:
        tests = table.cells["test"].xs(metric, level="metric").dropna()
        values = [round(test.smallest, decimals(metric)) for test in tests if test.smallest is not None]
        if any(values):  # rows that are equal show nothing
            ends = dict.fromkeys(f"{value:.{decimals(metric)}f}" for value in (min(values), max(values)))
            unit = " dB" if metric.startswith("psnr") else ""
            texts.append(f"{' to '.join(ends)}{unit} of {title(metric)}")
    return texts


def _about_training(table: Table) -> list[str]:
    """Rows that were trained for different numbers of steps, or with different seeds."""
    ours = _of(table.rows, "model")
    stubs = {line.variant: " ".join(line.stub) for line in table.lines}
    notes = []
    if "steps" in ours and ours["steps"].nunique() > 1:
        steps = ours.dropna(subset="steps").groupby("variant", sort=False)["steps"].agg(list)
        rows = []
        for variant, counts in steps.items():
            rows.append(f"{stubs[variant]}: {_range([round(count) for count in counts])}")
        notes.append(f"Rows were trained for different numbers of steps ({'; '.join(rows)}).")
    seeds = ours.groupby("variant", sort=False)["seed"].unique().map(sorted)
    if seeds.map(tuple).nunique() > 1:
        lines = [line.variant for line in table.ours if line.variant in seeds]
        rows = [f"{stubs[variant]}: {', '.join(map(str, seeds[variant]))}" for variant in lines]
        notes.append(f"Rows are of different seeds ({'; '.join(rows)}).")
    return notes


def _about_neighbors(table: Table) -> list[str]:
    """Rows whose neighbours are nearly those of the other ``recalibration.neighborhood``."""
    ours = _of(table.rows, "model")
    if table.layout.rows != "ablation" or "shared_neighbors" not in ours:
        return []
    shares = ours.dropna(subset="shared_neighbors").groupby("variant", sort=False)["shared_neighbors"].mean()
    if shares.empty or shares.max() <= MOSTLY_SHARED:
        return []
    return [
        f"**The switch of 3D unprojection hardly switches: {shares.max():.0%} of a token's"
        " neighbours are the same with and without it** (recalibration.k is close to the number of"
        " tokens; a share, such as 0.1, means the same at every size)."
    ]


def _about_runs(table: Table) -> list[str]:
    notes = []
    if table.measured["lacking"].map(bool).any():
        notes.append("(2/3): from 2 of 3 seeds; the others have no results yet.")
    runs = ((p, p.variant) for p in table.planned if not p.done)
    names = (f"{data_title(p.data)} {v.model} {v.ablation} seed {p.seed}" for p, v in runs)
    unfinished = list(dict.fromkeys(names))
    if unfinished:
        more = f" and {len(unfinished) - 4} more" if len(unfinished) > 4 else ""
        notes.append(f"No results yet (in progress or cut off): {'; '.join(unfinished[:4])}{more}.")
    groups: dict[tuple, list] = {}
    ours = _of(table.rows, "model")[["source", "variant", "data"]].drop_duplicates()
    for source, variant, data in ours.values:
        row = (variant.model, variant.encoder, variant.ablation, data)
        groups.setdefault(() if table.layout.rows == "ablation" else row, []).append(table.configs[source])
    keys = {}
    for group in groups.values():
        keys |= differing(group)
    shown = {"checkpoint"}
    for line in table.ours:
        shown |= {key for key, _ in line.variant.extra}
    for key in shown.union(*own_ablations(table).values()):
        keys.pop(key, None)
    if keys:
        notes.append(f"Runs side by side differ also in {differing_text(keys)}.")
    states = sorted(table.rows["git"].dropna().unique()) if "git" in table.rows else []
    if len(states) > 1:
        notes.append(f"The runs are of {len(states)} states of the code: {', '.join(states)}.")
    return notes
