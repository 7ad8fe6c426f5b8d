"""``report.json`` marks a directory as that of a prediction, whose files may be replaced later."""

import json
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from ghgs_lit.errors import InputError, require
from ghgs_lit.files import write_atomically, write_text_atomically
from ghgs_lit.readers import read_json
from ghgs_lit.runs.results import plain

REPORT = "report.json"  #: The file that lists the others


def require_free(directory: Path, names: Iterable[str], inputs: Iterable[Path] = ()) -> None:
    """Refuse to replace inputs, or files where no earlier prediction was. InputError: names the first."""
    read = {path.resolve() for path in inputs}
    is_known = _has_report(directory)
    for name in (*names, REPORT):
        path = directory / name
        expected = "another folder (out=...) than that of an input"
        require(path.resolve() not in read, str(path), expected, "the input")
        expected = "no file, or the folder of an earlier prediction (out=... names another one)"
        require(is_known or not path.exists(), str(path), expected, "another file")


def begin_files(directory: Path, names: Sequence[str]) -> None:
    """Write a report before the files, so that those of an interrupted run may be replaced, too. InputError:
    a file of another origin is in the way."""
    require_free(directory, names)
    write_text_atomically(directory / REPORT, json.dumps({"files": dict.fromkeys(names)}, indent=1))


def end_files(directory: Path, names: Sequence[str], report: Mapping[str, Any]) -> list[Path]:
    """Write the report, with the sizes of the files. Returns: their paths, that of the report last."""
    paths = [directory / name for name in names]
    sizes = {name: path.stat().st_size for name, path in zip(names, paths, strict=True)}
    text = json.dumps(plain({**report, "files": sizes}), indent=1, allow_nan=False)
    write_text_atomically(directory / REPORT, text)
    return [*paths, directory / REPORT]


def write_file(path: Path, content: Callable[[], bytes]) -> float:
    """Make and write a file. Returns: the seconds that it took."""
    begin = time.perf_counter()
    made = content()
    write_atomically(path, lambda temporary: temporary.write_bytes(made))
    return time.perf_counter() - begin


def _has_report(directory: Path) -> bool:
    try:
        report = read_json(directory / REPORT)
    except InputError:
        return False
    return isinstance(report, dict) and isinstance(report.get("files"), dict)
