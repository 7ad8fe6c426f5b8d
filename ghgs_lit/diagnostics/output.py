"""Tables of texts for Markdown and the terminal, and figures as PNG."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
from matplotlib.figure import Figure
from tabulate import tabulate

from ghgs_lit.files import write_atomically

Tables = dict[str, pd.DataFrame]  #: Tables of texts by their titles


def text(value: Any, form: str) -> str:
    """A value in the format ``form``, such as ``{:.2f}``; ``-`` where it is not known."""
    return "-" if pd.isna(value) else form.format(value)


def texts(frame: pd.DataFrame, columns: Mapping[str, tuple[str, str]]) -> pd.DataFrame:
    """The columns of ``frame`` that a table shows. ``columns``: by heading, the name of a column and its
    format; those that ``frame`` has not are left out."""
    known = {heading: column for heading, column in columns.items() if column[0] in frame}
    return pd.DataFrame({h: [text(v, form) for v in frame[name]] for h, (name, form) in known.items()})


def pivoted(frame: pd.DataFrame, index: str, columns: str, values: str, form: str) -> pd.DataFrame:
    """The column ``values`` in the format ``form``, by two others, whose entries keep their order."""
    table = frame.pivot(index=index, columns=columns, values=values)
    table = table.reindex(index=frame[index].unique(), columns=frame[columns].unique())
    return table.map(text, form=form).reset_index()


def to_markdown(table: pd.DataFrame) -> str:
    """One table, without its title."""
    return table.to_markdown(index=False, disable_numparse=True)


def document(title: str, notes: Sequence[str], tables: Tables) -> str:
    """A page of Markdown: notes, then each table below its title."""
    parts = [f"# {title}", *notes]
    for name, table in tables.items():
        parts += [f"## {name}", to_markdown(table)]
    return "\n\n".join(parts) + "\n"


def print_tables(tables: Tables) -> None:
    """Print tables; a line that wraps is better than a number that is cut."""
    for name, table in tables.items():
        print(name, tabulate(table, "keys", showindex=False, disable_numparse=True), sep="\n\n", end="\n\n")


def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure as PNG."""
    write_atomically(path, lambda temporary: figure.savefig(temporary, format="png", dpi=130))
