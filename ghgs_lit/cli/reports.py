"""Reports of ``ghgs benchmark`` and ``ghgs stress``: tables on the terminal and in Markdown, all numbers in
JSON, and the exit code."""

import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
from tabulate import tabulate

from ghgs_lit.cli.runtime import announce
from ghgs_lit.files import write_text_atomically
from ghgs_lit.runs.results import to_json_data

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


def pivot(frame: pd.DataFrame, index: str, columns: str, values: str, form: str) -> pd.DataFrame:
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


def print_tables(tables: Tables) -> None:
    """Print tables at full width."""
    for name, table in tables.items():
        print(name, tabulate(table, "keys", showindex=False, disable_numparse=True), sep="\n\n", end="\n\n")


def publish(
    directory: Path,
    command: str,
    notes: Sequence[str],
    tables: Tables,
    content: Mapping[str, Any],
    failures: Sequence[str],
) -> None:
    """Write ``<command>.md`` and ``<command>.json``, and print the latter's path and the failures.

    Args:
        directory: of the run.
        command: its name.
        notes: paragraphs of the Markdown page, the first one its title.
        tables: of the page, by title.
        content: of the JSON; numbers that are not finite become null.
        failures: why the command fails, a line each, for the error stream.

    Raises:
        SystemExit: code 1: there are failures.
    """
    parts = [f"# {notes[0]}", *notes[1:]]
    for title, table in tables.items():
        parts += [f"## {title}", table.to_markdown(index=False, disable_numparse=True)]
    write_text_atomically(directory / f"{command}.md", "\n\n".join(parts) + "\n")
    path = directory / f"{command}.json"
    write_text_atomically(path, json.dumps(to_json_data(content), indent=1, allow_nan=False) + "\n")
    announce(path)
    for line in failures:
        print(f"ghgs {command}: {line}", file=sys.stderr)
    if failures:
        raise SystemExit(1)
