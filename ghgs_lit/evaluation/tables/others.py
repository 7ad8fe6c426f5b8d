"""Results of other methods, read from a JSON file.

The file (``docs/tables.md`` describes it, ``docs/example_others.json`` is one)::

    {"format": "ghgs_lit.others", "format_version": 1, "method": "RoGSplat",
     "source": "their code at commit 8a196b6, run by us", "rows": [
       {"data": "thuman2", "split": "val", "targets": "release", "protocol": "release", "views": 4,
        "subject": "0501", "seed": 1, "metrics": {"psnr": 28.9, "ssim": 0.96}}]}

A row with ``subject`` has the values of one subject and can be tested; a row without has means over
``subjects`` subjects (optional). ``seed`` is optional.
"""

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ghgs_lit.errors import InputError
from ghgs_lit.evaluation.tables.records import Record, Setting, Variant
from ghgs_lit.runs.results import mean

FORMAT, FORMAT_VERSION = "ghgs_lit.others", 1
_TOP = {"format": str, "format_version": int, "method": str, "source": str, "rows": list}
_NEEDED = {"data": str, "split": str, "targets": str, "protocol": str, "views": int, "metrics": dict}
_OPTIONAL = {"subject": str, "seed": int, "subjects": int}
_KINDS = {str: "a text", int: "a whole number", list: "a list", dict: "a mapping"}


def _check(where: str, value: Any, kind: type) -> None:
    fits = isinstance(value, kind) and not (kind is int and isinstance(value, bool))
    if not fits or (kind is not int and not value):
        raise InputError(f"{where}: expected {_KINDS[kind]}; found {value!r}")


def _check_keys(where: str, found: Any, needed: Mapping[str, type], optional: Mapping[str, type]) -> None:
    if not isinstance(found, dict):
        raise InputError(f"{where}: expected a mapping; found {found!r}")
    known = {**needed, **optional}
    for key in found:
        if key not in known:
            raise InputError(f"{where}: expected the keys {', '.join(known)} only; found {key!r}")
    for key, kind in known.items():
        if key in found:
            _check(f"{where}.{key}", found[key], kind)
        elif key in needed:
            raise InputError(f"{where}: expected the key {key!r}; found {', '.join(found) or 'none'}")


def _validate(content: Any, where: str) -> None:
    """Refuse content that the head of this module does not describe; the message names the key."""
    _check_keys(where, content, _TOP, {})
    for key, expected in (("format", FORMAT), ("format_version", FORMAT_VERSION)):
        if content[key] != expected:
            raise InputError(f"{where}.{key}: expected {expected!r}; found {content[key]!r}")
    seen: dict[tuple, int] = {}
    for index, row in enumerate(content["rows"]):
        place = f"{where}.rows[{index}]"
        _check_keys(place, row, _NEEDED, _OPTIONAL)
        if row["views"] < 1 or row.get("subjects", 1) < 1:
            raise InputError(f"{place}: expected views and subjects of at least 1; found {row!r}")
        if "subject" in row and "subjects" in row:
            raise InputError(f"{place}: expected subject (one) or subjects (a mean's number); found both")
        for name, value in row["metrics"].items():
            is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
            if not is_number or not math.isfinite(value):
                raise InputError(f"{place}.metrics.{name}: expected a finite number; found {value!r}")
        key = (*_cell(row), row.get("subject"))
        if key in seen:
            raise InputError(f"{place}: expected each subject once a setting; found rows[{seen[key]}] again")
        seen[key] = index


def _cell(row: Mapping[str, Any]) -> tuple:
    return (*(row[k] for k in ("data", "split", "targets", "protocol", "views")), row.get("seed", 0))


def read_others(path: Path) -> list[Record]:
    """The records of another method's results file.

    Raises:
        FileNotFoundError: there is no such file.
        InputError: it is not as the head of this module describes.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: expected another method's results; found no such file")
    try:
        content = json.loads(path.read_text())
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: expected JSON; found {error}") from error
    _validate(content, path.name)
    groups: dict[tuple, list[dict]] = {}
    for row in content["rows"]:
        groups.setdefault(_cell(row), []).append(row)
    records = []
    for (data, split, targets, protocol, views, seed), rows in groups.items():
        subjects = {row["subject"]: row["metrics"] for row in rows if "subject" in row}
        if subjects and len(subjects) < len(rows):
            raise InputError(
                f"{path.name}: expected subjects or one mean for data={data}, views={views}; found both"
            )
        names = dict.fromkeys(name for row in rows for name in row["metrics"])
        means = {name: mean(row["metrics"].get(name) for row in rows) for name in names}
        count = len(subjects) or rows[0].get("subjects")
        setting = Setting(data, split, targets, protocol)
        about = {"source": content["source"]}
        variant = Variant("other", content["method"])
        records.append(Record(variant, setting, views, seed, means, str(path), count, subjects, None, about))
    return records
