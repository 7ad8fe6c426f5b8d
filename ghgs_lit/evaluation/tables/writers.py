r"""Writers of tables: Markdown, terminal, CSV, and LaTeX in the paper's layout.

LaTeX needs ``\usepackage{booktabs,multirow,adjustbox,pifont}``.
"""

import itertools
import re
from collections.abc import Callable, Sequence
from dataclasses import asdict
from typing import Any

import pandas as pd
from tabulate import tabulate

from ghgs_lit.evaluation.tables.layouts import Table, data_title, metric_of
from ghgs_lit.evaluation.tables.notes import MARK

COLUMNS = (
    "table", "kind", "method", "model", "encoder", "ablation", "unprojection", "semantic", "extra", "data",
    "split", "targets", "protocol", "views", "metric", "mean", "deviation", "seeds", "seeds_lacking",
    "subjects", "selection", "best", "test_seeds", "test_subjects", "test_difference", "test_low",
    "test_high", "test_p", "test_p_holm", "test_smallest", "runs",
)  # fmt: skip
NO_FIGURE = "-"
"""Text of a cell without a number, as in the paper."""
BEST = " ◂"
"""Mark of the best value in a terminal."""
Write = Callable[[str, str, bool], str]
"""Formats a cell from its number, the text after the number, and whether it is best."""


def _format_cell(cell: Any, write: Write) -> str:
    """Format a cell: number, deviation over seeds, mark, interval of its difference, missing seeds."""
    if pd.isna(cell.mean):
        return write("missing" if cell.lacking else NO_FIGURE, "", False)
    digits = metric_of(cell.Index[2]).decimals
    tail = f" ± {cell.deviation:.{digits}f}" if pd.notna(cell.deviation) else ""
    if cell.marked:
        tail += MARK
    if cell.test is not None and cell.test.low is not None:
        ends = [f"{end:+z.{digits}f}" for end in (cell.test.low, cell.test.high)]
        tail += f" [{', '.join(ends)}]" if any(map(float, ends)) else ""  # no interval for equal rows
    if cell.lacking:
        tail += f" ({len(cell.seeds)}/{len(cell.seeds) + len(cell.lacking)})"
    return write(f"{cell.mean:.{digits}f}", tail, cell.best)


def _format_cells(table: Table, write: Write) -> pd.DataFrame:
    """Formatted cells: a row for each line, columns by group and metric."""
    cells = [_format_cell(cell, write) for cell in table.cells.itertuples()]
    return pd.Series(cells, table.cells.index).unstack(["group", "metric"])


def _blocks(table: Table, write: Write) -> dict[str, list[tuple[str, list[str]]]]:
    """Kind and cells of each line by the title of its block: reported lines, then measured ones."""
    numbers = _format_cells(table, write)
    blocks: dict[str, list[tuple[str, list[str]]]] = {}
    for number, (variant, stub) in enumerate(table.lines):
        is_reported = variant.kind == "reported"
        title = f"as reported on {table.reported_on}, not measured here" if is_reported else "measured here"
        blocks.setdefault(title, []).append((variant.kind, [*stub, *numbers.loc[number]]))
    return blocks


def to_markdown(table: Table) -> str:
    """Write the table as Markdown, with its caption above and its notes below."""

    def write(number: str, tail: str, best: bool) -> str:
        text = number + tail.replace(MARK, rf"\{MARK}")
        return f"**{text}**" if best else text

    width = len(table.groups) * len(table.metrics)
    names = list(table.stub)
    for group, metric in itertools.product(table.groups, map(metric_of, table.metrics)):
        title = f"{metric.title} {metric.arrow}".strip()
        names.append(f"{group.title} {title}" if table.layout.heading != "none" else title)
    rows = []
    for title, lines in _blocks(table, write).items():
        if table.reported_on:
            rows.append([f"*{title}*", *[""] * (len(names) - 1)])
        rows += [cells for _, cells in lines]
    align = ["center" if len(table.stub) > 1 else "left"] * len(table.stub) + ["right"] * width
    text = tabulate(rows, names, "pipe", colalign=align, disable_numparse=True)
    notes = [rf"\{note}" if note.startswith(MARK + " ") else note for note in table.notes]
    return "\n\n".join((table.caption, text, *notes)) + "\n"


def to_terminal(table: Table) -> str:
    """Write the table for a terminal, with caption and notes; each group of columns has its own
    lines, which limits the width."""
    numbers = _format_cells(table, lambda number, tail, best: number + tail + BEST * best)
    rows = []
    for (i, line), (number, group) in itertools.product(enumerate(table.lines), enumerate(table.groups)):
        mark = "† " if line.variant.kind == "reported" else ""
        rows.append([mark + line.stub[0], *line.stub[1:], group.title, *numbers.loc[i][number]])
    names = [*table.stub, "", *(f"{metric.title} {metric.arrow}" for metric in map(metric_of, table.metrics))]
    text = tabulate(rows, names, disable_numparse=True)
    caption = table.caption.replace("in bold", f"marked{BEST}")
    text = "\n\n".join((caption, text, *table.notes)) + "\n"
    return text.replace("`", "").replace("**", "")


def to_csv(tables: Sequence[Table]) -> str:
    """Write all cells with all digits, a line each, by ``COLUMNS``; the mean is empty if a run is
    missing."""
    lines = []
    for number, table in enumerate(tables, 1):
        for cell in table.cells.itertuples():
            lines.append({"table": number, **_describe_row(table, cell), **_figures(table, cell)})
    frame = pd.DataFrame(lines, columns=COLUMNS)
    frame = frame.astype(dict.fromkeys(("subjects", "test_seeds", "test_subjects"), "Int64"))
    return frame.to_csv(index=False, lineterminator="\n")


def _describe_row(table: Table, cell: Any) -> dict[str, Any]:
    """Row, setting and metric of a cell, by column of the CSV file."""
    variant, stub = table.lines[cell.Index[0]]
    group = table.groups[cell.Index[1]]
    # Splits, targets and protocols of our runs do not apply to the paper's figures.
    setting = {"data": table.reported_on} if variant.kind == "reported" else table.rows.iloc[0]
    unprojection, semantic = variant.switches or (None, None)
    return {
        "kind": variant.kind,
        "method": "ours" if table.is_ablation else stub[0],
        "model": variant.model,
        "encoder": variant.encoder,
        "ablation": variant.ablation,
        "unprojection": unprojection,
        "semantic": semantic,
        "extra": " ".join(f"{key}={value}" for key, value in variant.extra),
        "data": group.data or data_title(setting["data"]),
        **{name: setting.get(name) for name in ("split", "targets", "protocol")},
        "views": group.views,
        "metric": cell.Index[2],
    }


def _figures(table: Table, cell: Any) -> dict[str, Any]:
    """Figures of a cell, by column of the CSV file; empty without a number."""
    if pd.isna(cell.mean):
        return {}
    figures = {"mean": cell.mean, "deviation": cell.deviation, "best": cell.best}
    if isinstance(cell.seeds, tuple):  # measured, not reported
        figures |= {
            "seeds": " ".join(map(str, sorted(cell.seeds))),
            "seeds_lacking": " ".join(map(str, cell.lacking)),
            "subjects": cell.count,
            "selection": table.options.subjects and table.options.subjects.pattern,
            "runs": cell.runs,
        }
    if cell.test is not None:
        figures |= {f"test_{name}": value for name, value in asdict(cell.test).items()}
        figures["test_p_holm"] = cell.test.corrected
    return figures


PREAMBLE = r"""% \usepackage{booktabs,multirow,adjustbox,pifont}
\providecommand{\cmark}{\ding{51}}
\providecommand{\xmark}{\ding{55}}
"""
_FLOAT = r"""\begin{%(float)s}[t]
\centering
\small
\begin{adjustbox}{max width=\linewidth}
%(tabular)s
\end{adjustbox}
%(notes)s\caption{%(caption)s}
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
    "↑": r"$\uparrow$", "↓": r"$\downarrow$", "°": r"$^\circ$", "†": r"$\dagger$",
}  # fmt: skip


def escape(text: str) -> str:
    """Escape plain text for LaTeX."""
    return text.translate(str.maketrans(_ESCAPES))


def markdown_to_latex(text: str) -> str:
    """Convert Markdown with ``**bold**`` and names in backticks to LaTeX."""
    text = re.sub(r"\*\*([^*]+)\*\*", r"\\textbf{\1}", escape(text))
    return re.sub(r"`([^`]*)`", r"\\texttt{\1}", text)


def _format_number(number: str, tail: str, best: bool) -> str:
    number = rf"\textbf{{{number}}}" if best else escape(number)
    return number + escape(tail).replace(MARK, "$^{*}$")


def _columns(table: Table) -> str:
    """Column specification: ``ccccc`` (ablation) or ``l | c c c | c c c`` (methods; data sets without
    the first bar)."""
    if table.is_ablation and len(table.groups) == 1:
        return "c" * (len(table.stub) + len(table.metrics))
    stub = " ".join("c" * len(table.stub)) if len(table.stub) > 1 else "l"
    columns = " | ".join([stub] + [" ".join("c" * len(table.metrics))] * len(table.groups))
    return columns.replace(" |", "", 1) if table.layout.columns == "data" else columns


def _head(table: Table) -> list[str]:
    """Rows of titles, with a rule below each group of columns."""
    stub = list(map(escape, table.stub))
    width = len(table.metrics)
    metrics = []
    for metric in map(metric_of, table.metrics):
        metrics.append(escape(metric.title) + (f"({escape(metric.arrow)})" if metric.arrow else ""))
    metrics *= len(table.groups)
    if table.layout.heading == "none":
        return [" & ".join([*stub, *metrics]) + r" \\"]
    names = [rf"\multirow{{2}}{{*}}{{{name}}}" for name in stub]
    rules = ""
    for number, group in enumerate(table.groups):
        names.append(rf"\multicolumn{{{width}}}{{c}}{{{escape(group.title)}}}")
        start = len(stub) + 1 + number * width
        rules += rf"\cmidrule(lr){{{start}-{start + width - 1}}}"
    return [" & ".join(names) + r" \\", rules, " & ".join([*[""] * len(stub), *metrics]) + r" \\"]


def _tabular(table: Table) -> str:
    """The ``tabular`` environment, with rules above blocks."""
    rows = [rf"\begin{{tabular}}{{{_columns(table)}}}", r"\toprule", *_head(table)]
    count = len(table.stub)
    for title, lines in _blocks(table, _format_number).items():
        rows.append(r"\midrule")
        if table.reported_on:
            title = rf"\multicolumn{{{len(lines[0][1])}}}{{l}}{{\emph{{{escape(title)}}}}} \\"
            rows += [title, r"\midrule"]
        for kind, cells in lines:
            names = list(map(escape, cells[:count]))
            if kind == "model" and not table.is_ablation:
                names = [rf"\textbf{{{name}}}" for name in names]
            rows.append(" & ".join([*names, *cells[count:]]) + r" \\")
    return "\n".join([*rows, r"\bottomrule", r"\end{tabular}"])


def to_latex(table: Table, label: str) -> str:
    """Write a float with the table, its caption, notes in small print, and label; requires
    ``PREAMBLE``."""
    notes = "\n".join(rf"{markdown_to_latex(note)}\par" for note in table.notes)
    parts = {
        "float": "table*" if len(table.groups) * len(table.metrics) >= _WIDE else "table",
        "tabular": _tabular(table),
        "notes": f"\\par\\smallskip\n\\parbox{{\\linewidth}}{{\\footnotesize\n{notes}\n}}\n" if notes else "",
        "caption": markdown_to_latex(table.caption),
        "label": label,
    }
    return _FLOAT % parts
