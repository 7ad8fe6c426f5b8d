r"""Tables as LaTeX in the paper's layout: booktabs, one bar before each group of columns.

A table needs ``\usepackage{booktabs,multirow,adjustbox,pifont}``.
"""

import re

from ghgs_lit.evaluation.tables.layouts import Line, Table, arrow, title
from ghgs_lit.evaluation.tables.text import CellText, cell_text

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


def _number(text: CellText) -> str:
    mean = rf"\textbf{{{text.mean}}}" if text.best else escape(text.mean)
    spread = rf" $\pm$ {text.spread}" if text.spread else ""
    return mean + spread + escape(text.tail).replace("*", "$^{*}$")


def _row(table: Table, line: Line) -> str:
    stub = [escape(part) for part in line.stub]
    if line.is_ours and table.layout.rows == "methods":
        stub = [rf"\textbf{{{part}}}" for part in stub]
    numbers = [_number(cell_text(line.cells.get(column), line, column[1])) for column in table.columns]
    return " & ".join((*stub, *numbers)) + r" \\"


def _column_spec(table: Table) -> str:
    """``ccccc`` for the ablation, ``l | c c c | c c c`` for methods, without the first bar for data sets."""
    if table.layout.rows == "ablation" and len(table.groups) == 1:
        return "c" * (len(table.stub) + len(table.metrics))
    stub = "c c" if len(table.stub) == 2 else "l"
    spec = " | ".join([stub] + [" ".join("c" * len(table.metrics))] * len(table.groups))
    return spec.replace(" |", "", 1) if table.layout.columns == "data" else spec


def _header(table: Table) -> list[str]:
    """The groups with rules below them, then the metrics."""
    first, width = len(table.stub), len(table.metrics)
    metrics = [f"{escape(title(m))}{_ARROWS[arrow(m)]}" for _, m in table.columns]
    if table.layout.heading == "none":
        return [" & ".join((*map(escape, table.stub), *metrics)) + r" \\"]
    stub = [rf"\multirow{{2}}{{*}}{{{escape(name)}}}" for name in table.stub]
    groups = [rf"\multicolumn{{{width}}}{{c}}{{{escape(group.title)}}}" for group in table.groups]
    starts = [first + 1 + i * width for i in range(len(groups))]
    rules = "".join(rf"\cmidrule(lr){{{start}-{start + width - 1}}}" for start in starts)
    return [
        " & ".join((*stub, *groups)) + r" \\",
        rules,
        " & ".join([""] * first + metrics).strip() + r" \\",
    ]


def _tabular(table: Table) -> str:
    """The ``tabular`` environment alone."""
    lines = [rf"\begin{{tabular}}{{{_column_spec(table)}}}", r"\toprule", *_header(table)]
    width = len(table.stub) + len(table.columns)
    for block in table.blocks:
        lines.append(r"\midrule")
        if len(table.blocks) > 1:
            name = escape(table.block_title(block))
            lines += [rf"\multicolumn{{{width}}}{{l}}{{\emph{{{name}}}}} \\", r"\midrule"]
        lines += [_row(table, line) for line in block]
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}"])


def to_latex(table: Table, label: str) -> str:
    """A float with the table, its caption, its notes in small print and its label."""
    name = "table*" if len(table.columns) >= _WIDE else "table"
    # Deviations, marks and long names make rows wide; the paper scales its tables to the line, too.
    body = "\\begin{adjustbox}{max width=\\linewidth}\n" + _tabular(table) + "\n\\end{adjustbox}"
    notes = [r"\par\smallskip", r"\parbox{\linewidth}{\footnotesize"]
    notes += [rf"{prose(note)}\par" for note in table.notes] + ["}"]
    return "\n".join(
        [
            rf"\begin{{{name}}}[t]",
            r"\centering",
            r"\small",
            body,
            *(notes if table.notes else []),
            rf"\caption{{{prose(table.caption)}}}",
            rf"\label{{{label}}}",
            rf"\end{{{name}}}",
            "",
        ]
    )
