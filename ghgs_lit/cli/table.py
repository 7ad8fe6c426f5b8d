"""``ghgs table``: format the runs below a directory as one of the paper's tables."""

import re
from pathlib import Path
from typing import TYPE_CHECKING

from ghgs_lit.cli.runtime import announce, output_dir, write_config
from ghgs_lit.config.options import Options
from ghgs_lit.errors import InputError, require
from ghgs_lit.evaluation import tables as t
from ghgs_lit.files import resolve_path, write_text_atomically

if TYPE_CHECKING:
    from ghgs_lit.cli.verbs import Table


def _list_values(options: Options, key: str) -> tuple | None:
    """Values of a key that holds one value or a list, None if there are none; rejects repeated values.

    ``key`` is dotted; its last part is the field.
    """
    value = getattr(options, key.rpartition(".")[2])
    values = (value,) if isinstance(value, str | int) else tuple(value or ())
    require(len(set(values)) == len(values), key, "different values", list(values))
    return values or None


def _compile_expression(key: str, text: str) -> re.Pattern[str]:
    """Compile the regular expression of a key."""
    try:
        return re.compile(text)
    except re.error as error:
        raise InputError(f"{key}: expected a regular expression; found {error}") from None


def _options(run: "Table") -> t.TableOptions:
    """Options for building tables; checks regular expressions and repeated values."""
    unit = _compile_expression("test.unit", run.test.unit or "(.+)")
    require(unit.groups >= 1, "test.unit", "a regular expression with a group", unit.pattern)
    return t.TableOptions(
        layout=t.LAYOUTS[run.layout],
        views=_list_values(run.evaluation, "evaluation.views"),
        targets=_list_values(run.evaluation, "evaluation.targets"),
        metrics=_list_values(run, "columns"),
        reported=run.reported,
        test=run.test,
        unit=unit,
        subjects=None if run.subjects is None else _compile_expression("subjects", run.subjects),
    )


def run(verb: "Table") -> None:
    """Print the tables and write them as CSV, LaTeX and Markdown.

    Raises:
        InputError: A key, a run or a file with results of other methods is wrong.
    """
    directory = output_dir()
    write_config(verb, directory)
    options = _options(verb)
    # Resolved, so that a run found by two paths counts once.
    folders = [resolve_path(path) for path in _list_values(verb, "runs") or ()]
    others = [t.read_others(Path(p).expanduser()) for p in _list_values(verb, "others") or ()]
    sweep = t.read_sweep(folders, _list_values(verb, "by") or ())
    tables = t.build_tables(sweep, others, options)
    labels = [f"table:{options.layout.name}" + (f"-{i}" if i else "") for i in range(len(tables))]
    latex = "\n".join(t.to_latex(table, label) for table, label in zip(tables, labels, strict=True))
    write_text_atomically(directory / "table.csv", t.to_csv(tables))
    write_text_atomically(directory / "table.tex", t.PREAMBLE + latex)
    write_text_atomically(directory / "table.md", "\n".join(map(t.to_markdown, tables)))
    print("\n".join(map(t.to_terminal, tables)))
    announce(directory / "table.md")
