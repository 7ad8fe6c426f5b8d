r"""Writers of tables, with caption and notes: Markdown, CSV, and LaTeX in the paper's layout.

LaTeX needs ``\usepackage{booktabs,multirow,adjustbox,pifont}``.
"""

import re
from collections.abc import Sequence
from typing import Any

import pandas as pd
from tabulate import tabulate

from ghgs_lit.config.keys import EXPECTED_TO_DIFFER
from ghgs_lit.evaluation.tables.layouts import Table, data_title, metric_of, paper
from ghgs_lit.evaluation.tables.runs import TRAINING_COUNTS, describe, find_differences
from ghgs_lit.evaluation.tables.significance import ALPHA, POWER

MARK = r"\*"
"""Mark of a significant difference, in Markdown."""
_NO_SEMANTICS = "Features carry no semantics: the encoder was never trained for semantics."
_TRAINED_VIEWS = (
    "Each column shows the model that was trained with as many input views;"
    " `by=[views.training_counts]` gives each model a row."
)
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
COLUMNS = (
    "table", "kind", "method", "model", "encoder", "ablation", "unprojection", "semantic", "extra", "data",
    "split", "targets", "protocol", "views", "metric", "mean", "deviation", "seeds", "seeds_lacking",
    "subjects", "best", "test_seeds", "test_subjects", "test_difference", "test_low", "test_high", "test_p",
    "test_p_holm", "test_smallest", "runs",
)  # fmt: skip


def write_caption(table: Table) -> str:
    """Caption of a table in one line of Markdown: data, subjects, protocol, model and number of
    seeds."""
    first = table.rows.iloc[0]
    variant = first["variant"]
    names = " and ".join(f"`{name}`" for name in dict.fromkeys(table.rows["data"]))
    counts = " or ".join(map(str, sorted({int(count) for count in table.measured["count"]})))
    parts = [
        f"Data {names}",
        f"{counts or 'no'} subject{'s' * (counts != '1')} of `{first['split']}`",
        f"targets `{first['targets']}`",
        f"metrics `{first['protocol']}`",
    ]
    if table.is_ablation:
        parts += [f"model `{variant.model}`", f"encoder `{variant.encoder}`", *variant.extra]
    views = ", ".join(str(count) for count in dict.fromkeys(group.views for group in table.groups))
    parts.append(f"{views} input views")
    spread = lead = ""
    seeds = table.measured["seeds"].map(len)
    if seeds.max() > 1:
        spread = f" ± deviation over {_format_range(seeds)} seeds"
        lead = " where it leads by more than the deviation"
    return f"{', '.join(parts)}; mean over subjects{spread}, best of the measured methods in bold{lead}."


def _format_range(values: pd.Series) -> str:
    return " to ".join(f"{value:.0f}" for value in dict.fromkeys((values.min(), values.max())))


def write_notes(table: Table) -> list[str]:
    """Notes below a table that affect its interpretation, as paragraphs of Markdown."""
    ours = table.rows[[variant.kind == "model" for variant in table.rows["variant"]]]
    by_row = ours.groupby("variant", sort=False)
    shared = by_row["shared_neighbors"].mean().max() if "shared_neighbors" in ours else 0
    applies = {
        _NO_SEMANTICS: table.is_ablation and not ours["variant"].iloc[0].has_semantics,
        _TRAINED_VIEWS: len(table.groups) > 1 and table.rows["trained_views"].nunique() > 1,
        _NEIGHBORS: table.is_ablation and shared > _MOSTLY_SHARED,
        _STEPS: "steps" in ours and ours["steps"].nunique() > 1,
        _SEEDS: by_row["seed"].agg(lambda seeds: tuple(sorted(set(seeds)))).nunique() > 1,
        _PARTIAL: table.measured["lacking"].map(bool).any(),
    }
    notes = [note for note, holds in applies.items() if holds]
    if table.reported_on:
        notes.append(
            f"† Reported: figures that {paper()['source']}, prints for {' and '.join(table.reported_on)},"
            " measured by its authors. They are not comparable with figures on other data, splits, views or"
            " protocols."
        )
    if table.left_out:
        notes.append(f"Runs of the folder that are not in the table: {table.left_out}.")
    planned = table.planned.groupby(["data", "variant", "seed"], sort=False).groups
    if planned:
        names = [f"{data_title(data)} {row.model} {row.ablation} seed {seed}" for data, row, seed in planned]
        notes.append(f"No results yet (in progress or cut off): {'; '.join(names)}.")
    notes += _describe_test(table)
    if keys := _find_differences(table, ours):
        notes.append(f"Runs side by side differ also in {describe(keys)}.")
    states = sorted(table.rows["git"].dropna().unique())
    if len(states) > 1:
        notes.append(f"The runs are of {len(states)} states of the code: {', '.join(states)}.")
    return notes


def _find_differences(table: Table, ours: pd.DataFrame) -> dict[str, list[str]]:
    """Keys in which runs of a row, or of all rows of ablations, differ, except for those in row names."""
    expected = {*EXPECTED_TO_DIFFER, "checkpoint"}
    if ours["trained_views"].notna().any():
        expected.add(TRAINING_COUNTS)
    groups: dict[tuple, list] = {}
    for source, rows in ours.groupby("source", sort=False):
        variant = rows["variant"].iloc[0]
        expected.update(text.partition("=")[0] for text in variant.extra)
        row = (variant.model, variant.encoder, variant.ablation, rows["data"].iloc[0])
        groups.setdefault(() if table.is_ablation else row, []).append(table.configs[source])
    keys = {}
    for group in groups.values():
        keys |= find_differences(group, expected)
    return keys


def _describe_test(table: Table) -> list[str]:
    """Meaning of the marks, and the smallest difference that the seeds and subjects could show."""
    tests = table.cells[table.cells["test_seeds"].notna()]
    known = tests[tests["test_p"].notna()]
    if known.empty:
        lack = "subjects" if (tests["test_seeds"] > 1).any() else "seeds"
        return [f"No differences are marked: rows have fewer than two {lack} in common."] * (len(tests) > 0)
    models = [line.variant.ablation for line in table.lines if line.variant.kind == "model"]
    against = "the row of the whole method" if models.count("full") == 1 else "its column's best row"
    metric = metric_of(known.index[0][2])
    return [
        f"{MARK} {metric.title} differs beyond chance from {against} (p < {ALPHA:g} after Holm's"
        f" correction over {table.comparisons} comparisons of {_format_range(known['test_seeds'])} seeds and"
        f" {_format_range(known['test_subjects'])} subjects). In brackets the {1 - ALPHA:.0%} interval of the"
        f" difference. A difference of {known['test_smallest'].max():.{metric.decimals}f} is found with"
        f" {POWER:.0%} power."
    ]


def _format_cell(cell: Any) -> str:
    """Format a cell: number, deviation over seeds, mark, interval of its difference, missing seeds."""
    if pd.isna(cell.mean):
        return "missing" if cell.lacking else "-"
    digits = metric_of(cell.Index[2]).decimals
    text = f"{cell.mean:.{digits}f}"
    if cell.best:
        text = f"**{text}**"
    if pd.notna(cell.deviation):
        text += f" ± {cell.deviation:.{digits}f}"
    if cell.marked:
        text += MARK
    if pd.notna(cell.test_low):
        ends = [f"{end:+z.{digits}f}" for end in (cell.test_low, cell.test_high)]
        text += f" [{', '.join(ends)}]" if any(map(float, ends)) else ""  # no interval for equal rows
    if cell.lacking:
        text += f" ({len(cell.seeds)}/{len(cell.seeds) + len(cell.lacking)})"
    return text


def _format(table: Table) -> pd.DataFrame:
    """Texts of a table as Markdown: columns by title of the group and of the metric; first those that
    name a row."""
    texts = [_format_cell(cell) for cell in table.cells.itertuples()]
    cells = pd.Series(texts, table.cells.index).unstack(["group", "metric"])
    heads = [("", name) for name in table.stub]
    for group, name in cells:
        metric = metric_of(name)
        heads.append((table.groups[group].title, f"{metric.title} {metric.arrow}".strip()))
    rows = [[*line.stub, *cells.loc[number]] for number, line in enumerate(table.lines)]
    return pd.DataFrame(rows, columns=pd.MultiIndex.from_tuples(heads))


def to_markdown(table: Table) -> str:
    """Write the table as Markdown, with its caption above and its notes below."""
    frame = _format(table)
    names = [" ".join(head).strip() for head in frame]
    align = ["center" if len(table.stub) > 1 else "left"] * len(table.stub)
    align += ["right"] * (len(names) - len(align))
    text = tabulate(frame.to_numpy(), names, "pipe", colalign=align, disable_numparse=True)
    return "\n\n".join((write_caption(table), text, *write_notes(table))) + "\n"


def to_csv(tables: Sequence[Table]) -> str:
    """Write all cells with all digits, a line each, by ``COLUMNS``; the mean is empty if a run is
    missing."""
    frames = []
    for number, table in enumerate(tables, 1):
        cells = table.cells.rename(columns={"count": "subjects"})
        cells["best"] = cells["best"].where(cells["mean"].notna())
        cells["seeds_lacking"] = cells["lacking"].map(_join)
        cells["seeds"] = cells["seeds"].map(_join, na_action="ignore")
        about = [_describe_row(table, *place) for place in cells.index]
        frames.append(pd.DataFrame(about, cells.index).join(cells).assign(table=number))
    frame = pd.concat(frames).reindex(columns=COLUMNS)
    frame = frame.astype(dict.fromkeys(("subjects", "test_seeds", "test_subjects"), "Int64"))
    return frame.to_csv(index=False, lineterminator="\n")


def _join(seeds: tuple[int, ...]) -> str:
    return " ".join(map(str, sorted(seeds)))


def _describe_row(table: Table, line: int, group: int, metric: str) -> dict[str, Any]:
    """Row, setting and metric of a cell, by column of the CSV file."""
    variant, _ = table.lines[line]
    _, views, data = table.groups[group]
    first = table.rows.iloc[0]
    unprojection, semantic = variant.switches or (None, None)
    about = {
        "kind": variant.kind,
        "method": variant.name,
        "model": variant.model,
        "encoder": variant.encoder,
        "ablation": variant.ablation,
        "unprojection": unprojection,
        "semantic": semantic,
        "extra": " ".join(variant.extra),
        "views": views,
        "metric": metric,
    }
    if variant.kind == "reported":  # our split, targets and protocol do not apply to the paper's figures
        return {**about, "data": data or table.reported_on[0]}
    setting = {name: first[name] for name in ("split", "targets", "protocol")}
    return {**about, **setting, "data": data or data_title(first["data"])}


PREAMBLE = r"""% \usepackage{booktabs,multirow,adjustbox,pifont}
\providecommand{\cmark}{\ding{51}}
\providecommand{\xmark}{\ding{55}}
"""
_FLOAT = r"""\begin{%(float)s}[t]
\centering
\small
\begin{adjustbox}{max width=\linewidth}
%(tabular)s\end{adjustbox}
\par\smallskip
\parbox{\linewidth}{\footnotesize
%(notes)s
}
\caption{%(caption)s}
\label{%(label)s}
\end{%(float)s}
"""
"""Wide tables are scaled to the line width, as in the paper."""
_WIDE = 7
"""Minimum number of columns of a table that spans both columns of the page."""
_ESCAPES = {
    "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_", "{": r"\{",
    "}": r"\}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "<": r"\textless{}",
    ">": r"\textgreater{}", "|": r"\textbar{}", "✓": r"\cmark{}", "✗": r"\xmark{}", "±": r"$\pm$",
    "↑": r"$\uparrow$", "↓": r"$\downarrow$", "°": r"$^\circ$", "†": r"$\dagger$", "★": "$^{*}$",
}  # fmt: skip


def markdown_to_latex(text: str) -> str:
    """Convert Markdown with ``**bold**``, names in backticks and ``MARK`` to LaTeX."""
    text = text.replace(MARK, "★").translate(str.maketrans(_ESCAPES))
    text = re.sub(r"\*\*([^*]+)\*\*", r"\\textbf{\1}", text)
    return re.sub(r"`([^`]*)`", r"\\texttt{\1}", text)


def to_latex(table: Table, label: str) -> str:
    """Write a float with the table, its caption, notes in small print, and label; requires
    ``PREAMBLE``."""
    frame = _format(table).map(markdown_to_latex)
    frame.columns = frame.columns.map(lambda head: tuple(map(markdown_to_latex, head)))
    stub = "c" if len(table.stub) > 1 else "l"
    columns = "|".join([stub * len(table.stub)] + ["c" * len(table.metrics)] * len(table.groups))
    style = frame.style.hide(axis="index")
    parts = {
        "float": "table*" if frame.shape[1] - len(table.stub) >= _WIDE else "table",
        "tabular": style.to_latex(column_format=columns, hrules=True, multicol_align="c"),
        "notes": "\n".join(rf"{markdown_to_latex(note)}\par" for note in write_notes(table)),
        "caption": markdown_to_latex(write_caption(table)),
        "label": label,
    }
    return _FLOAT % parts
