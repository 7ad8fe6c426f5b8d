"""``report.json`` of a directory lists the files of predictions; later runs replace only those."""

import json
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from ghgs_lit.errors import InputError, require
from ghgs_lit.files import write_atomically, write_text_atomically
from ghgs_lit.parsing import read_json
from ghgs_lit.runs.results import to_json_data

REPORT = "report.json"  #: Name of the report


def require_free(directory: Path, names: Iterable[str], inputs: Iterable[Path] = ()) -> None:
    """Check that writing replaces neither inputs nor files that no prediction wrote.

    Args:
        directory: where files will be written.
        names: names of the files, relative to the directory; the report is checked, too.
        inputs: input files of the prediction.

    Raises:
        InputError: a file would be replaced; the message names the first one.
    """
    read = {os.path.realpath(path) for path in inputs}
    written = _list_written(directory)
    for name in (*names, REPORT):
        path = directory / name
        expected = "another folder (out=...) than that of an input"
        require(os.path.realpath(path) not in read, str(path), expected, "the input")
        is_ours = name in written or (name == REPORT and written)
        expected = "no file, or one that an earlier prediction wrote (out=... names another folder)"
        require(is_ours or not path.exists(), str(path), expected, "another file")


def begin_files(directory: Path, names: Sequence[str]) -> None:
    """List files in the report before they are written, so that it covers those of an interrupted run.

    Args:
        directory: where files will be written.
        names: names of the files, relative to the directory.

    Raises:
        InputError: a file that no earlier prediction wrote has one of the names.
    """
    require_free(directory, names)
    _write_report(directory, dict.fromkeys(names), {})


def end_files(directory: Path, names: Sequence[str], report: Mapping[str, Any]) -> list[Path]:
    """Write the report, with the sizes of the files.

    Args:
        directory: where the files are.
        names: names of the files, relative to the directory.
        report: plain data, without NaN or infinity.

    Returns:
        The paths of the files, that of the report last.
    """
    sizes = {name: (directory / name).stat().st_size for name in names}
    _write_report(directory, sizes, report)
    return [directory / name for name in (*names, REPORT)]


def write_file(path: Path, content: Callable[[], bytes]) -> None:
    """Compute a file's content and write it atomically.

    Args:
        path: path of the file.
        content: returns the content.
    """
    made = content()
    write_atomically(path, lambda temporary: temporary.write_bytes(made))


def _write_report(directory: Path, files: Mapping[str, int | None], report: Mapping[str, Any]) -> None:
    """Write the report, which also lists other files of earlier predictions."""
    written = _list_written(directory)
    kept = {name: size for name, size in written.items() if (directory / name).exists()}
    text = json.dumps(to_json_data({**report, "files": {**kept, **files}}), indent=1, allow_nan=False)
    write_text_atomically(directory / REPORT, text)


def _list_written(directory: Path) -> dict[str, int | None]:
    """Files that the report of a directory lists, with their sizes; empty without a report."""
    try:
        report = read_json(directory / REPORT)
    except InputError:
        return {}
    files = report.get("files") if isinstance(report, dict) else None
    return files if isinstance(files, dict) else {}
