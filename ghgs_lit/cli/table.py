"""``ghgs table``: format the runs below a directory as one of the paper's tables."""

from typing import TYPE_CHECKING, Any

from ghgs_lit.cli.runtime import announce, output_dir, write_config
from ghgs_lit.errors import require
from ghgs_lit.evaluation import tables as t
from ghgs_lit.files import resolve_path, write_text_atomically

if TYPE_CHECKING:
    from ghgs_lit.cli.verbs import Table


def _list_values(key: str, value: Any) -> tuple:
    """Values of a key that holds one value or a list; rejects repeated values."""
    values = (value,) if isinstance(value, str | int) else tuple(value or ())
    require(len(set(values)) == len(values), key, "different values", list(values))
    return values


def run(verb: "Table") -> None:
    """Print the tables and write them as CSV, LaTeX and Markdown.

    Raises:
        InputError: A key or a run is wrong.
    """
    directory = output_dir()
    write_config(verb, directory)
    views = _list_values("evaluation.views", verb.evaluation.views)
    targets = _list_values("evaluation.targets", verb.evaluation.targets)
    columns = _list_values("columns", verb.columns)
    # Resolved, so that a run found by two paths counts once.
    folders = [resolve_path(path) for path in _list_values("runs", verb.runs)]
    sweep = t.read_sweep(folders, _list_values("by", verb.by))
    layout = t.LAYOUTS[verb.layout]
    tables = t.build_tables(sweep, layout, views, targets, columns, verb.reported, verb.unit)
    latex = []
    for number, table in enumerate(tables):
        latex.append(t.to_latex(table, f"table:{layout.name}" + f"-{number}" * (number > 0)))
    markdown = "\n".join(map(t.to_markdown, tables))
    write_text_atomically(directory / "table.csv", t.to_csv(tables))
    write_text_atomically(directory / "table.tex", t.PREAMBLE + "\n".join(latex))
    write_text_atomically(directory / "table.md", markdown)
    print(markdown)
    announce(directory / "table.md")
