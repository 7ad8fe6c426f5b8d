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

import pandas as pd

from ghgs_lit.errors import InputError
from ghgs_lit.evaluation.tables.records import SETTING, Variant

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


def read_others(path: Path) -> pd.DataFrame:
    """The lines of another method's results file, as :class:`Sweep` has them of ours.

    ``said`` is the file's ``source``; lines that are means have no ``subject`` and may have a ``count``.

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
    rows = pd.DataFrame([{"subject": None, "subjects": None, "seed": 0} | row for row in content["rows"]])
    for (data, _, _, _, views, _), part in rows.groupby([*SETTING, "views", "seed"], sort=False)["subject"]:
        if part.notna().any() and len(part) > part.notna().sum():
            raise InputError(
                f"{path.name}: expected subjects or one mean for data={data}, views={views}; found both"
            )
    metrics = pd.DataFrame(list(rows.pop("metrics"))).astype(float)
    variant, rows = Variant("other", content["method"]), rows.rename(columns={"subjects": "count"})
    rows = rows.assign(variant=variant, source=str(path), run=None, said=content["source"])
    return rows.join(metrics).astype({"count": float})
