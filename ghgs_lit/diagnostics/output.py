"""Output of tables as Markdown and on the terminal."""

from collections.abc import Mapping, Sequence
from typing import Any

import pandas as pd
from tabulate import tabulate

Tables = dict[str, pd.DataFrame]  #: Tables of texts by their titles


def text(value: Any, form: str) -> str:
    """A value as text; ``-`` if unknown.

    Args:
        value: a number or text; None and NaN are unknown.
        form: its format, such as ``{:.2f}``.
    """
    return "-" if pd.isna(value) else form.format(value)


def texts(frame: pd.DataFrame, columns: Mapping[str, tuple[str, str]]) -> pd.DataFrame:
    """Table of texts.

    Args:
        frame: the values.
        columns: column of ``frame`` and its format by heading; absent columns are left out.
    """
    table = {}
    for heading, (name, form) in columns.items():
        if name in frame:
            table[heading] = [text(value, form) for value in frame[name]]
    return pd.DataFrame(table)


def pivoted(frame: pd.DataFrame, index: str, columns: str, values: str, form: str) -> pd.DataFrame:
    """Pivot table of texts; rows and columns keep their order.

    Args:
        frame: the values, one row for each cell.
        index: column that names the rows.
        columns: column that names the columns.
        values: column that has the values.
        form: their format, such as ``{:.2f}``.
    """
    table = frame.pivot(index=index, columns=columns, values=values)
    table = table.reindex(index=frame[index].unique(), columns=frame[columns].unique())
    return table.map(text, form=form).reset_index()


def document(title: str, notes: Sequence[str], tables: Tables) -> str:
    """Markdown page of notes, then each table below its title.

    Args:
        title: of the page.
        notes: paragraphs.
        tables: by title.
    """
    parts = [f"# {title}", *notes]
    for name, table in tables.items():
        parts += [f"## {name}", table.to_markdown(index=False, disable_numparse=True)]
    return "\n\n".join(parts) + "\n"


def print_tables(tables: Tables) -> None:
    """Print tables at full width."""
    for name, table in tables.items():
        print(name, tabulate(table, "keys", showindex=False, disable_numparse=True), sep="\n\n", end="\n\n")
