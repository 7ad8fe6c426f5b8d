"""``ghgs table``: format the runs below a directory as one of the paper's tables."""

import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ghgs_lit.cli.runtime import announce, output_dir, write_config
from ghgs_lit.errors import InputError, require
from ghgs_lit.evaluation import tables as t
from ghgs_lit.files import resolve_path, write_text_atomically

if TYPE_CHECKING:
    from ghgs_lit.cli.verbs import Table


def _list_values(key: str, value: Any) -> tuple | None:
    """Values of a key that holds one value or a list, None if there are none; rejects repeated values."""
    values = (value,) if isinstance(value, str | int) else tuple(value or ())
    require(len(set(values)) == len(values), key, "different values", list(values))
    return values or None


def _compile_unit(text: str | None) -> re.Pattern[str] | None:
    """Compile the regular expression of the key ``unit``."""
    try:
        unit = None if text is None else re.compile(text)
    except re.error as error:
        raise InputError(f"unit: expected a regular expression; found {error}") from None
    require(unit is None or unit.groups, "unit", "a regular expression with a group", text)
    return unit


def run(verb: "Table") -> None:
    """Print the tables and write them as CSV, LaTeX and Markdown.

    Raises:
        InputError: A key, a run or a file with results of other methods is wrong.
    """
    directory = output_dir()
    write_config(verb, directory)
    unit = _compile_unit(verb.unit)
    views = _list_values("evaluation.views", verb.evaluation.views)
    targets = _list_values("evaluation.targets", verb.evaluation.targets)
    columns = _list_values("columns", verb.columns)
    # Resolved, so that a run found by two paths counts once.
    folders = [resolve_path(path) for path in _list_values("runs", verb.runs) or ()]
    others = [t.read_others(Path(path).expanduser()) for path in _list_values("others", verb.others) or ()]
    sweep = t.read_sweep(folders, _list_values("by", verb.by) or ())
    layout = t.LAYOUTS[verb.layout]
    tables = t.build_tables(sweep, others, layout, views, targets, columns, verb.reported, unit)
    labels = [f"table:{layout.name}" + (f"-{i}" if i else "") for i in range(len(tables))]
    latex = "\n".join(t.to_latex(table, label) for table, label in zip(tables, labels, strict=True))
    markdown = "\n".join(map(t.to_markdown, tables))
    write_text_atomically(directory / "table.csv", t.to_csv(tables))
    write_text_atomically(directory / "table.tex", t.PREAMBLE + latex)
    write_text_atomically(directory / "table.md", markdown)
    print(markdown)
    announce(directory / "table.md")
