r"""Writers of tables: Markdown, terminal, CSV, and LaTeX in the paper's layout.

LaTeX needs ``\usepackage{booktabs,multirow,adjustbox,pifont}``.
"""

import itertools
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict
from typing import Any

import pandas as pd
from tabulate import tabulate

from ghgs_lit.evaluation.tables.layouts import Table, arrow, data_title, decimals, title
from ghgs_lit.evaluation.tables.notes import MARK

COLUMNS = (
    "table", "kind", "method", "model", "encoder", "ablation", "unprojection", "semantic", "extra", "data",
    "split", "targets", "protocol", "views", "metric", "mean", "deviation", "seeds", "seeds_lacking",
    "subjects", "selection", "best", "test_seeds", "test_subjects", "test_difference", "test_low",
    "test_high", "test_p", "test_p_holm", "test_smallest", "runs",
)  # fmt: skip
NO_FIGURE = "-"
"""Where there is no figure, as the paper prints it."""
BEST = " ◂"
"""Mark of the best value in a terminal."""
Write = Callable[[str, str, bool], str]
"""Writes a cell of its number, what follows it, and whether it is best."""


def _cell(cell: Any, write: Write) -> str:
    """A cell as printed: number, deviation over seeds, mark, interval of its difference,
    missing seeds."""
    if pd.isna(cell.mean):
        return write("missing" if cell.lacking else NO_FIGURE, "", False)
    digits = decimals(cell.Index[2])
    tail = ""
    if pd.notna(cell.deviation):
        tail = f" ± {cell.deviation:.{digits}f}"
    if cell.marked:
        tail += MARK
    if cell.test is not None and cell.test.low is not None:
        ends = [f"{end:+z.{digits}f}" for end in (cell.test.low, cell.test.high)]
        tail += f" [{', '.join(ends)}]" if any(map(float, ends)) else ""  # equal rows differ by nothing
    if cell.lacking:
        tail += f" ({len(cell.seeds)}/{len(cell.seeds) + len(cell.lacking)})"
    return write(f"{cell.mean:.{digits}f}", tail, cell.best)


def texts(table: Table, write: Write) -> pd.DataFrame:
    """Cells as printed.

    Args:
        table: With its cells.
        write: Writes the number of a cell, with what follows it.

    Returns:
        A row for each line, columns by group and metric.
    """
    cells = [_cell(cell, write) for cell in table.cells.itertuples()]
    return pd.Series(cells, table.cells.index).unstack(["group", "metric"])


def heading(table: Table, group: int, metric: str) -> str:
    """Title of a column after that of its group, if the layout has one.

    Args:
        table: With its groups.
        group: Number of the group of columns.
        metric: Of the column.

    Returns:
        Text such as ``4-view PSNR ↑``.
    """
    named = f"{table.groups[group].title} " if table.layout.heading != "none" else ""
    return named + f"{title(metric)} {arrow(metric)}".strip()


def to_markdown(table: Table) -> str:
    """The table with its caption above and its notes below.

    Args:
        table: With its cells.

    Returns:
        Markdown.
    """

    numbers = texts(table, lambda number, tail, best: _bold(number + tail.replace(MARK, rf"\{MARK}"), best))
    rows = []
    for block in table.blocks:
        if table.reported_on:
            empty = [""] * (len(table.stub) + numbers.shape[1] - 1)
            rows.append([f"*{table.block_title(block)}*", *empty])
        rows += [[*table.lines[i].stub, *numbers.loc[i]] for i in block]
    names = [*table.stub, *(heading(table, *column) for column in numbers)]
    align = ["center" if len(table.stub) > 1 else "left"] * len(table.stub) + ["right"] * numbers.shape[1]
    frame = pd.DataFrame(rows, columns=pd.Index(names))
    text = frame.to_markdown(index=False, colalign=align, disable_numparse=True)
    notes = [rf"\{note}" if note.startswith(f"{MARK} ") else note for note in table.notes]
    return "\n\n".join((table.caption, text, *notes)) + "\n"


def _bold(text: str, best: bool) -> str:
    return f"**{text}**" if best else text


def to_terminal(table: Table) -> str:
    """The table for a terminal: each group of columns has lines of its own,
    so that no table is wide.

    Args:
        table: With its cells.

    Returns:
        Plain text with caption and notes.
    """
    numbers = texts(table, lambda number, tail, best: number + tail + BEST * best)
    rows = []
    for line in itertools.chain.from_iterable(table.blocks):
        first, *more = table.lines[line].stub
        mark = "† " if table.lines[line].is_reported else ""
        for number, group in enumerate(table.groups):
            rows.append([mark + first, *more, group.title, *numbers.loc[line][number]])
    names = [*table.stub, "", *(f"{title(metric)} {arrow(metric)}" for metric in table.metrics)]
    text = tabulate(rows, names, disable_numparse=True)
    caption = table.caption.replace("in bold", f"marked{BEST}")
    paragraphs = (each.replace("`", "").replace("**", "") for each in (caption, *table.notes))
    return "\n\n".join((next(paragraphs), text, *paragraphs)) + "\n"


def to_csv(tables: Sequence[Table]) -> str:
    """All cells with all digits, one on each line; the mean is empty if a run is missing.

    Args:
        tables: With their cells.

    Returns:
        CSV with the columns ``COLUMNS``.
    """
    lines = []
    for number, table in enumerate(tables, 1):
        lines += [_line(number, table, cell) for cell in table.cells.itertuples()]
    frame = pd.DataFrame(lines, columns=COLUMNS)
    frame = frame.astype(dict.fromkeys(("subjects", "test_seeds", "test_subjects"), "Int64"))
    return frame.to_csv(index=False, lineterminator="\n")


def _line(number: int, table: Table, cell: Any) -> dict[str, Any]:
    line = table.lines[cell.Index[0]]
    group = table.groups[cell.Index[1]]
    variant = line.variant
    setting = table.rows.iloc[0]
    reported = line.is_reported
    about = {
        "table": number,
        "method": line.stub[0] if table.layout.rows == "methods" else "ours",
        **{name: getattr(variant, name) for name in ("kind", "model", "encoder", "ablation")},
        **dict(zip(("unprojection", "semantic"), variant.switches or (), strict=False)),
        "extra": " ".join(f"{key}={value}" for key, value in variant.extra),
        "data": group.data or (table.reported_on if reported else data_title(setting["data"])),
        # Our splits, targets and protocols do not apply to the paper's figures.
        **({} if reported else {name: setting[name] for name in ("split", "targets", "protocol")}),
        "views": group.views,
        "metric": cell.Index[2],
    }
    if pd.isna(cell.mean):
        return about
    about |= {"mean": cell.mean, "deviation": cell.deviation, "best": cell.best}
    if not reported:
        about |= {"seeds": " ".join(map(str, sorted(cell.seeds))), "subjects": cell.count, "runs": cell.runs}
        about["seeds_lacking"] = " ".join(map(str, cell.lacking))
        about["selection"] = table.options.subjects and table.options.subjects.pattern
    if cell.test is not None:
        test = asdict(cell.test)
        about |= {"test_p_holm": test.pop("corrected"), **{f"test_{name}": v for name, v in test.items()}}
    return about


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
    """Plain text as LaTeX.

    Args:
        text: Any.

    Returns:
        The same with escaped characters.
    """
    return "".join(_ESCAPES.get(c, c) for c in text)


def prose(text: str) -> str:
    """Markdown as LaTeX.

    Args:
        text: With ``**bold**`` and names in backticks.

    Returns:
        LaTeX.
    """
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
    """Columns such as ``ccccc`` (ablation) or ``l | c c c | c c c`` (methods; no first bar for
    data sets)."""
    if table.layout.rows == "ablation" and len(table.groups) == 1:
        return "c" * (len(table.stub) + len(table.metrics))
    stub = " ".join("c" * len(table.stub)) if len(table.stub) > 1 else "l"
    spec = " | ".join([stub] + [" ".join("c" * len(table.metrics))] * len(table.groups))
    return spec.replace(" |", "", 1) if table.layout.columns == "data" else spec


def _row(cells: Iterable[str]) -> str:
    return " & ".join(cells) + r" \\"


def _head(table: Table) -> list[str]:
    """Rows of titles, with a rule below each group of columns."""
    stub = list(map(escape, table.stub))
    width = len(table.metrics)
    metrics = [f"{escape(title(metric))}{_ARROWS[arrow(metric)]}" for metric in table.metrics]
    if table.layout.heading == "none":
        return [_row([*stub, *metrics * len(table.groups)])]
    names = [rf"\multirow{{2}}{{*}}{{{name}}}" for name in stub]
    groups = [rf"\multicolumn{{{width}}}{{c}}{{{escape(group.title)}}}" for group in table.groups]
    starts = [len(stub) + 1 + i * width for i in range(len(groups))]
    rules = "".join(rf"\cmidrule(lr){{{start}-{start + width - 1}}}" for start in starts)
    return [_row([*names, *groups]), rules, _row([*[""] * len(stub), *metrics * len(groups)])]


def _tabular(table: Table) -> str:
    """The ``tabular`` environment, with rules above blocks."""
    numbers = texts(table, _number)
    body = []
    for block in table.blocks:
        body.append(r"\midrule")
        if len(table.blocks) > 1:
            count = len(table.stub) + numbers.shape[1]
            name = escape(table.block_title(block))
            body += [rf"\multicolumn{{{count}}}{{l}}{{\emph{{{name}}}}} \\", r"\midrule"]
        for line in block:
            names = map(escape, table.lines[line].stub)
            if table.lines[line].is_ours and table.layout.rows == "methods":
                names = (rf"\textbf{{{name}}}" for name in names)
            body.append(_row([*names, *numbers.loc[line]]))
    begin = rf"\begin{{tabular}}{{{_column_spec(table)}}}"
    return "\n".join([begin, r"\toprule", *_head(table), *body, r"\bottomrule", r"\end{tabular}"])


def to_latex(table: Table, label: str) -> str:
    """A float with the table, its caption, notes in small print and label.

    Args:
        table: With its cells.
        label: Of the float.

    Returns:
        LaTeX, which needs the packages of ``PREAMBLE``.
    """
    name = "table*" if len(table.groups) * len(table.metrics) >= _WIDE else "table"
    notes = [r"\par\smallskip", r"\parbox{\linewidth}{\footnotesize"]
    notes += [rf"{prose(note)}\par" for note in table.notes] + ["}"]
    return "\n".join(
        [
            rf"\begin{{{name}}}[t]",
            r"\centering",
            r"\small",
            # Rows can be wide; the paper scales its tables to the line, too.
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
