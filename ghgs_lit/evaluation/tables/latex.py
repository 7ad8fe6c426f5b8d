r"""Tables as LaTeX in the paper's layout: booktabs, one bar before each group of columns.

A table needs ``\usepackage{booktabs,multirow,adjustbox,pifont}``.
"""

import re

import pandas as pd

from ghgs_lit.evaluation.tables.layouts import Table, arrow, title
from ghgs_lit.evaluation.tables.notes import MARK
from ghgs_lit.evaluation.tables.writers import texts

PREAMBLE = r"""% \usepackage{booktabs,multirow,adjustbox,pifont}
\providecommand{\cmark}{\ding{51}}
\providecommand{\xmark}{\ding{55}}
"""
_WIDE = 7
"""Minimum number of columns of a table that spans both columns of the page."""
_ESCAPES = {
    "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_", "{": r"\{",
    "}": r"\}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "<": r"\textless{}",
    ">": r"\textgreater{}", "|": r"\textbar{}", "✓": r"\cmark{}", "✗": r"\xmark{}", "±": r"$\pm$",
    "↑": r"$\uparrow$", "↓": r"$\downarrow$", "°": r"$^\circ$", "†": r"$\dagger$",
}  # fmt: skip
_ARROWS = {"↑": r"($\uparrow$)", "↓": r"($\downarrow$)", "": ""}


def escape(text: str) -> str:
    """Plain text as LaTeX."""
    return "".join(_ESCAPES.get(c, c) for c in text)


def prose(text: str) -> str:
    """A sentence of Markdown as LaTeX: ``**bold**`` and names in backticks."""
    parts = re.split(r"(`[^`]*`|\*\*[^*]+\*\*)", text)
    marks = {"`": (r"\texttt{", 1), "*": (r"\textbf{", 2)}
    return "".join(
        f"{marks[p[0]][0]}{escape(p[marks[p[0]][1] : -marks[p[0]][1]])}}}"
        if len(p) > 2 and p[0] in marks and p[0] == p[-1]
        else escape(p)
        for p in parts
    )


def _number(number: str, tail: str, best: bool) -> str:
    number = rf"\textbf{{{number}}}" if best else escape(number)
    return number + escape(tail).replace(MARK, "$^{*}$")


def _column_spec(table: Table) -> str:
    """``ccccc`` for the ablation, ``l | c c c | c c c`` for methods, without the first bar for data sets."""
    if table.layout.rows == "ablation" and len(table.groups) == 1:
        return "c" * (len(table.stub) + len(table.metrics))
    stub = "c c" if len(table.stub) == 2 else "l"
    spec = " | ".join([stub] + [" ".join("c" * len(table.metrics))] * len(table.groups))
    return spec.replace(" |", "", 1) if table.layout.columns == "data" else spec


def _frame(table: Table) -> pd.DataFrame:
    numbers = texts(table, _number)
    named = table.layout.heading != "none"
    stub = [
        (rf"\multirow{{2}}{{*}}{{{escape(name)}}}", "") if named else ("", escape(name))
        for name in table.stub
    ]
    metrics = [
        (escape(table.groups[group].title), f"{escape(title(metric))}{_ARROWS[arrow(metric)]}")
        for group, metric in numbers
    ]
    rows = []
    for i in (i for block in table.blocks for i in block):
        bold = table.lines[i].is_ours and table.layout.rows == "methods"
        names = map(escape, table.lines[i].stub)
        rows.append([*(rf"\textbf{{{name}}}" if bold else name for name in names), *numbers.loc[i]])
    columns = pd.MultiIndex.from_tuples([*stub, *metrics])
    return pd.DataFrame(rows, columns=columns if named else columns.droplevel(0))


def _tabular(table: Table) -> str:
    """The ``tabular`` environment alone: that of pandas, with rules below groups and above blocks."""
    frame = _frame(table)
    text = frame.style.hide(axis="index").to_latex(
        column_format=_column_spec(table), hrules=True, multicol_align="c"
    )
    lines = text.strip().split("\n")
    first, end = lines.index(r"\midrule") + 1, lines.index(r"\bottomrule")
    head, rows, body = lines[: first - 1], lines[first:end], []
    if table.layout.heading != "none":
        stub, width = len(table.stub), len(table.metrics)
        starts = [stub + 1 + i * width for i in range(len(table.groups))]
        head.insert(-1, "".join(rf"\cmidrule(lr){{{start}-{start + width - 1}}}" for start in starts))
    for block in table.blocks:
        body.append(r"\midrule")
        if len(table.blocks) > 1:
            name = escape(table.block_title(block))
            body += [rf"\multicolumn{{{frame.shape[1]}}}{{l}}{{\emph{{{name}}}}} \\", r"\midrule"]
        body += [rows.pop(0) for _ in block]
    return "\n".join([*head, *body, *lines[end:]])


def to_latex(table: Table, label: str) -> str:
    """A float with the table, its caption, its notes in small print and its label."""
    name = "table*" if len(table.groups) * len(table.metrics) >= _WIDE else "table"
    notes = [r"\par\smallskip", r"\parbox{\linewidth}{\footnotesize"]
    notes += [rf"{prose(note)}\par" for note in table.notes] + ["}"]
    return "\n".join(
        [
            rf"\begin{{{name}}}[t]",
            r"\centering",
            r"\small",
            # Deviations, marks and long names make rows wide; the paper scales its tables to the line, too.
            r"\begin{adjustbox}{max width=\linewidth}",
            _tabular(table),
            r"\end{adjustbox}",
            *(notes if table.notes else []),
            rf"\caption{{{prose(table.caption)}}}",
            rf"\label{{{label}}}",
            rf"\end{{{name}}}",
            "",
        ]
    )
