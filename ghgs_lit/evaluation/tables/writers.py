"""Tables as Markdown, on a terminal and as CSV."""

import re
from collections.abc import Callable, Sequence
from dataclasses import asdict
from typing import Any

import pandas as pd
from tabulate import tabulate

from ghgs_lit.evaluation.tables.layouts import Line, Table, arrow, data_title, decimals, title
from ghgs_lit.evaluation.tables.notes import MARK

#: What a terminal shows bold and green.
_BEST = "\033[1;32m{}\033[0m"
COLUMNS = (
    "table", "kind", "method", "model", "encoder", "ablation", "unprojection", "semantic", "extra", "data",
    "split", "targets", "protocol", "views", "metric", "mean", "deviation", "seeds", "seeds_lacking",
    "subjects", "best", "test_seeds", "test_subjects", "test_difference", "test_low", "test_high", "test_p",
    "test_p_holm", "runs",
)  # fmt: skip
Write = Callable[[str, str, bool], str]
"""Writes a cell of its number, what follows it, and whether it is best."""


def _cell(cell: Any, line: Line, write: Write) -> str:
    """A cell as printed: the number, the deviation over seeds, a mark with its interval, missing seeds."""
    if pd.isna(cell.mean):
        return write(line.absent, "", False)
    digits, tail = decimals(cell.Index[2]), ""
    if pd.notna(cell.deviation):
        tail = f" ± {cell.deviation:.{digits}f}"
    if cell.marked:
        tail += f"{MARK} [{cell.test.low:+.{digits}f}, {cell.test.high:+.{digits}f}]"
    if cell.lacking:
        tail += f" ({len(cell.seeds)}/{len(cell.seeds) + len(cell.lacking)})"
    return write(f"{cell.mean:.{digits}f}", tail, cell.best)


def texts(table: Table, write: Write) -> pd.DataFrame:
    """The numbers as printed: a row for each line, and columns by group and metric."""
    cells = [_cell(cell, table.lines[cell.Index[0]], write) for cell in table.cells.itertuples()]
    return pd.Series(cells, table.cells.index).unstack(["group", "metric"])


def heading(table: Table, group: int, metric: str, between: str) -> str:
    """The name of a column after that of its group, where the layout has one."""
    named = f"{table.groups[group].title}{between}" if table.layout.heading != "none" else ""
    return named + f"{title(metric)} {arrow(metric)}".strip()


def to_markdown(table: Table) -> str:
    """The table with its caption above and its notes below."""

    def write(number: str, tail: str, best: bool) -> str:
        text = number + tail.replace(MARK, rf"\{MARK}")
        return f"**{text}**" if best else text

    numbers = texts(table, write)
    rows = []
    for block in table.blocks:
        if table.reported_on:
            empty = [""] * (len(table.stub) + numbers.shape[1] - 1)
            rows.append([f"*{table.block_title(block)}*", *empty])
        rows += [[*table.lines[i].stub, *numbers.loc[i]] for i in block]
    names = [*table.stub, *(heading(table, *column, " ") for column in numbers)]
    align = ["center" if len(table.stub) > 1 else "left"] * len(table.stub) + ["right"] * numbers.shape[1]
    frame = pd.DataFrame(rows, columns=pd.Index(names))
    text = frame.to_markdown(index=False, colalign=align, disable_numparse=True)
    return "\n\n".join((table.caption, text, *table.notes)) + "\n"


def to_terminal(table: Table, width: int) -> str:
    """The numbers for a terminal; groups stand below one another where the table is wider than ``width``."""

    def write(number: str, tail: str, best: bool) -> str:
        # What is in brackets stands below its number: beside it few tables would fit.
        lines = re.sub(r" (?=[\[(])", "\n", number + tail).split("\n")
        return "\n".join(_BEST.format(line) if best else line for line in lines)

    numbers = texts(table, write)
    whole = _terminal(table, numbers)
    if max(map(len, re.sub(r"\033\[[\d;]*m", "", whole).splitlines())) <= width:
        return whole
    return "\n\n".join(_terminal(table, numbers[[group]]) for group in range(len(table.groups)))


def _terminal(table: Table, numbers: pd.DataFrame) -> str:
    short = {"3D Unproj.": "3D\nunp.", "Semantic Cons.": "sem.\ncons."}
    names = [short.get(name, name) for name in table.stub]
    names += [heading(table, *column, "\n") for column in numbers]
    rows = []
    for block in table.blocks:
        mark = "† " if table.lines[block[0]].is_reported else ""
        rows += [[mark + (stub := table.lines[i].stub)[0], *stub[1:], *numbers.loc[i]] for i in block]
    align = ["center" if len(table.stub) > 1 else "left"] * len(table.stub) + ["right"] * numbers.shape[1]
    return tabulate(rows, names, colalign=align, disable_numparse=True)


def to_csv(tables: Sequence[Table]) -> str:
    """All cells with all digits, one for each line; the mean is empty where a run is missing."""
    lines = [
        _line(number, table, cell)
        for number, table in enumerate(tables, 1)
        for cell in table.cells.itertuples()
    ]
    frame = pd.DataFrame(lines, columns=COLUMNS)
    frame = frame.astype(dict.fromkeys(("subjects", "test_seeds", "test_subjects"), "Int64"))
    return frame.to_csv(index=False, lineterminator="\n")


def _line(number: int, table: Table, cell: Any) -> dict[str, Any]:
    line, group = table.lines[cell.Index[0]], table.groups[cell.Index[1]]
    variant, setting, reported = line.variant, table.rows.iloc[0], line.is_reported
    about = {
        "table": number,
        "method": line.stub[0] if table.layout.rows == "methods" else "ours",
        **{name: getattr(variant, name) for name in ("kind", "model", "encoder", "ablation")},
        **dict(zip(("unprojection", "semantic"), variant.switches or (), strict=False)),
        "extra": " ".join(f"{key}={value}" for key, value in variant.extra),
        "data": group.data or (table.reported_on if reported else data_title(setting["data"])),
        # Our names of splits, targets and protocols do not apply to the paper's figures.
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
    if cell.test is not None:
        test = asdict(cell.test)
        about |= {"test_p_holm": test.pop("corrected"), **{f"test_{name}": v for name, v in test.items()}}
    return about
