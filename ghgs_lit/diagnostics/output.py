"""Output of tables as Markdown and on the terminal, and of figures as PNG."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
from matplotlib.figure import Figure
from tabulate import tabulate

from ghgs_lit.files import write_atomically

Tables = dict[str, pd.DataFrame]  #: Tables of texts by their titles


def text(value: Any, form: str) -> str:
    """A value in the format ``form``, such as ``{:.2f}``; ``-`` if unknown."""
    return "-" if pd.isna(value) else form.format(value)


def texts(frame: pd.DataFrame, columns: Mapping[str, tuple[str, str]]) -> pd.DataFrame:
    """Table of texts from ``frame``. ``columns``: name and format by heading; absent columns are left out."""
    table = {}
    for heading, (name, form) in columns.items():
        if name in frame:
            table[heading] = [text(value, form) for value in frame[name]]
    return pd.DataFrame(table)


def pivoted(frame: pd.DataFrame, index: str, columns: str, values: str, form: str) -> pd.DataFrame:
    """Pivot table of the column ``values`` in the format ``form``; rows and columns keep their order."""
    table = frame.pivot(index=index, columns=columns, values=values)
    table = table.reindex(index=frame[index].unique(), columns=frame[columns].unique())
    return table.map(text, form=form).reset_index()


def to_markdown(table: pd.DataFrame) -> str:
    """A table as Markdown."""
    return table.to_markdown(index=False, disable_numparse=True)


def document(title: str, notes: Sequence[str], tables: Tables) -> str:
    """Markdown page of notes, then each table below its title."""
    parts = [f"# {title}", *notes]
    for name, table in tables.items():
        parts += [f"## {name}", to_markdown(table)]
    return "\n\n".join(parts) + "\n"


def print_tables(tables: Tables) -> None:
    """Print tables at full width."""
    for name, table in tables.items():
        print(name, tabulate(table, "keys", showindex=False, disable_numparse=True), sep="\n\n", end="\n\n")


def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure as PNG."""
    write_atomically(path, lambda temporary: figure.savefig(temporary, format="png", dpi=130))
