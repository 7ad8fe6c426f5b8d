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
    written = _written_before(directory)
    for name in (*names, REPORT):
        path = directory / name
        expected = "another folder (out=...) than that of an input"
        require(os.path.realpath(path) not in read, str(path), expected, "the input")
        expected = "no file, or one that an earlier prediction wrote (out=... names another folder)"
        require(name in written or not path.exists(), str(path), expected, "another file")


def begin_files(directory: Path, names: Sequence[str]) -> list[str]:
    """List files in the report before they are written, so that it covers those of an interrupted run.

    Args:
        directory: where files will be written.
        names: names of the files, relative to the directory.

    Returns:
        Names of other files of earlier predictions.

    Raises:
        InputError: a file that no earlier prediction wrote has one of the names.
    """
    require_free(directory, names)
    return _write_report(directory, dict.fromkeys(names), {})


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


def _write_report(directory: Path, files: Mapping[str, int | None], report: Mapping[str, Any]) -> list[str]:
    """Write the report, which also lists other files of earlier predictions, and return their names."""
    written = _written_before(directory)
    earlier = [name for name in written if name not in (REPORT, *files) and (directory / name).exists()]
    kept = {"earlier_files": earlier} if earlier else {}
    text = json.dumps(to_json_data({**report, "files": files, **kept}), indent=1, allow_nan=False)
    write_text_atomically(directory / REPORT, text)
    return earlier


def _written_before(directory: Path) -> list[str]:
    """Names of the files that the report of a directory lists; empty without a report."""
    try:
        report = read_json(directory / REPORT)
    except InputError:
        return []
    if not isinstance(report, dict) or not isinstance(report.get("files"), dict):
        return []
    return [REPORT, *report["files"], *report.get("earlier_files", ())]
