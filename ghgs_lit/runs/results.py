"""``metrics.json`` and ``metrics.csv``: one row for each subject, target and method, with provenance."""

import csv
import io
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from ghgs_lit.config.keys import lookup
from ghgs_lit.errors import InputError, require
from ghgs_lit.files import write_text_atomically
from ghgs_lit.runs.provenance import config_hash

FORMAT_VERSION = 3
"""The version that is written, and the only one that is read."""
METHOD = "model"
"""The method of the rows of a trained model; others are baselines."""
KEYS = ("method", "subject", "views", "targets", "target", "inputs", "skip")
"""What a row describes; all other entries of a row are metrics."""

#: Types of JSON, in words for messages.
_KINDS = {
    str: "a text",
    int: "a whole number",
    float: "a number or null",
    list: "a list",
    dict: "a mapping",
}

Row = dict[str, Any]


def mean(values: Iterable[float | None]) -> float | None:
    """Mean of the defined values (neither None nor nan); None without any."""
    known = [v for v in values if v is not None and not math.isnan(v)]
    return sum(known) / len(known) if known else None


def metric_names(rows: Sequence[Row]) -> list[str]:
    """Names of the numbers in the rows, in order of appearance."""
    return list(dict.fromkeys(name for row in rows for name in row if name not in KEYS))


def by_protocol(rows: Sequence[Row]) -> dict[tuple, dict[str, list[Row]]]:
    """Rows by (method, views, targets), then by subject."""
    groups: dict[tuple, dict[str, list[Row]]] = {}
    for row in rows:
        key = (row["method"], row["views"], row["targets"])
        groups.setdefault(key, {}).setdefault(row["subject"], []).append(row)
    return groups


def summarize(rows: Sequence[Row]) -> list[Row]:
    """Means over subjects for each method, number of views and kind of target.

    A subject's targets are averaged first, so that each subject counts once.
    """
    names = metric_names(rows)
    return [
        {
            **dict(zip(("method", "views", "targets"), key, strict=True)),
            "subjects": len(subjects),
            **{name: mean(mean(row.get(name) for row in own) for own in subjects.values()) for name in names},
        }
        for key, subjects in by_protocol(rows).items()
    ]


def plain(value: Any) -> Any:
    """``value`` for JSON, in which infinite numbers and nan become null."""
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, Mapping):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(v) for v in value]
    return value


def write_results(directory: Path, rows: Sequence[Row], provenance: Mapping[str, Any]) -> Path:
    """Write ``metrics.csv`` and then ``metrics.json``, whose presence marks the run as complete."""
    if not rows:
        raise InputError("evaluation: expected at least one subject and target; found none")
    # Rows of several runs can be concatenated and still be distinguished.
    origin = {
        "data": provenance.get("data", {}).get("name"),
        "split": provenance.get("data", {}).get("split"),
        "protocol": provenance.get("protocol", {}).get("metrics"),
        "seed": provenance.get("seed"),
        "config_hash": provenance.get("config_hash"),
    }
    columns = [*(key for key in KEYS if any(key in row for row in rows)), *metric_names(rows), *origin]
    table = io.StringIO()
    writer = csv.DictWriter(table, columns, restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows({**row, "inputs": " ".join(row["inputs"]), **origin} for row in plain(rows))
    write_text_atomically(directory / "metrics.csv", table.getvalue())
    content = {
        "format_version": FORMAT_VERSION,
        "provenance": provenance,
        "summary": summarize(rows),
        "rows": rows,
    }
    path = directory / "metrics.json"
    write_text_atomically(path, json.dumps(plain(content), indent=1, allow_nan=False))
    return path


def entry(place: str, content: Any, key: str, kind: type) -> Any:
    """The value at a dotted key of results that were read.

    Args:
        place: the file, or the place in it, for messages.
        content: the results, or a part of them.
        key: the dotted key.
        kind: the type of the value; ``float`` is any number or None.

    Raises:
        InputError: there is no such key, or its value is of another type; names place and key.
    """
    value = lookup(content, key)
    kinds = int | float | None if kind is float else kind
    fits = isinstance(value, kinds) and not isinstance(value, bool)
    short = isinstance(value, str | int | float)
    require(fits, f"{place}: {key}", _KINDS[kind], value if short else type(value).__name__)
    return value


def _check_rows(path: Path, content: Mapping[str, Any]) -> None:
    """Refuse rows and means that were edited until they are none."""
    for part, texts in (("rows", ("method", "subject", "targets")), ("summary", ("method", "targets"))):
        for index, row in enumerate(entry(str(path), content, part, list)):
            place = f"{path}: {part}[{index}]"
            for key in texts:
                entry(place, row, key, str)
            entry(place, row, "views", int)
            for key in row:
                if key not in KEYS:
                    entry(place, row, key, float)


def read_results(path: Path) -> dict[str, Any]:
    """Read a ``metrics.json``.

    Raises:
        InputError: the file is not a whole ``metrics.json``, or its configuration is not the one that was
            measured; the message names it.
    """
    try:
        content = json.loads(path.read_text())
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: expected a metrics.json; found {error}") from error
    found = content.get("format_version") if isinstance(content, dict) else type(content).__name__
    if found != FORMAT_VERSION:
        again = "`ghgs evaluate` measures again"
        raise InputError(f"{path}: expected format_version {FORMAT_VERSION}; found {found} ({again})")
    _check_rows(path, content)
    source = entry(str(path), content, "provenance", dict)
    if isinstance(source.get("config"), dict):
        fitting, hashed = config_hash(source["config"]), source.get("config_hash")
        expected = f"a configuration that fits its config_hash {hashed}"
        require(fitting == hashed, f"{path}: provenance.config", expected, f"one of {fitting}")
    return content
