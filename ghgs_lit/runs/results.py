"""Results of a run: ``metrics.json``, with one row per subject, target and method,
and their provenance (configuration, code, versions, machine)."""

import datetime
import hashlib
import importlib.metadata
import json
import math
import platform
import reprlib
import subprocess
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from ghgs_lit.config.keys import WITHOUT_INFLUENCE, flatten, is_below
from ghgs_lit.errors import InputError, require
from ghgs_lit.files import write_text_atomically
from ghgs_lit.parsing import read_json

FORMAT_VERSION = 3  #: Version written, and the only one accepted when reading
METHOD = "model"  #: ``method`` of rows of a trained model; other values are baselines
KEYS = ("method", "subject", "views", "targets", "target", "inputs", "skip")
"""Keys that identify a row; all other entries of a row are metrics."""

PACKAGES = ("ghgs-lit", "torch", "lightning", "torchmetrics", "kornia", "numpy", "scipy", "gsplat")
Row = dict[str, Any]
Model = TypeVar("Model", bound=BaseModel)


def mean(values: Iterable[float | None]) -> float | None:
    """Mean of the values that are neither None nor NaN; None if there are no such values."""
    known = [v for v in values if v is not None and not math.isnan(v)]
    return sum(known) / len(known) if known else None


def metric_names(rows: Sequence[Row]) -> list[str]:
    """Names of the metrics in rows, in order of appearance."""
    names = dict.fromkeys(name for row in rows for name in row)
    return [name for name in names if name not in KEYS]


def group_by_protocol(rows: Sequence[Row]) -> dict[tuple, dict[str, list[Row]]]:
    """Group rows by (method, views, targets), then by subject."""
    groups: dict[tuple, dict[str, list[Row]]] = {}
    for row in rows:
        key = (row["method"], row["views"], row["targets"])
        groups.setdefault(key, {}).setdefault(row["subject"], []).append(row)
    return groups


def summarize(rows: Sequence[Row]) -> list[Row]:
    """Mean metrics over subjects for each method, number of views and target protocol.

    Each subject's targets are averaged first, so that every subject has the same weight.

    Returns:
        One row per group, with the number of ``subjects`` and the means.
    """
    names = metric_names(rows)
    summary = []
    for (method, views, targets), subjects in group_by_protocol(rows).items():
        entry = {"method": method, "views": views, "targets": targets, "subjects": len(subjects)}
        for name in names:
            of_subjects = []
            for of_one in subjects.values():
                of_subjects.append(mean(row.get(name) for row in of_one))
            entry[name] = mean(of_subjects)
        summary.append(entry)
    return summary


def to_json_data(value: Any) -> Any:
    """Convert a value to plain data for JSON: keys become text; infinities and NaN become None."""
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, Mapping):
        return {str(k): to_json_data(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [to_json_data(v) for v in value]
    return value


def write_results(directory: Path, rows: Sequence[Row], provenance: Mapping[str, Any]) -> Path:
    """Write ``metrics.json``, which marks the run as complete.

    Args:
        directory: Directory of the run.
        rows: Rows of its evaluation.
        provenance: See :func:`provenance`.

    Returns:
        Path of ``metrics.json``.

    Raises:
        InputError: There are no rows.
    """
    if not rows:
        raise InputError("evaluation: expected at least one subject and target; found none")
    content = {
        "format_version": FORMAT_VERSION,
        "provenance": provenance,
        "summary": summarize(rows),
        "rows": rows,
    }
    path = directory / "metrics.json"
    write_text_atomically(path, json.dumps(to_json_data(content), indent=1, allow_nan=False))
    return path


class _Mean(BaseModel):
    """Entry of ``summary``; all further keys are metrics."""

    model_config = ConfigDict(extra="allow", strict=True, allow_inf_nan=False)
    __pydantic_extra__: dict[str, float | None]
    method: str
    views: int
    targets: str


class _Row(_Mean):
    subject: str
    target: str | None = None
    inputs: list[str] = []
    skip: str | None = None


class _Results(BaseModel):
    model_config = ConfigDict(strict=True)
    provenance: dict[str, Any]
    summary: Annotated[list[_Mean], Field(min_length=1)]
    rows: list[_Row]


def validate(model: type[Model], content: Any, where: str) -> Model:
    """Validate content with a pydantic model.

    Args:
        model: Class of the model.
        content: Plain data.
        where: Name of the content in error messages.

    Returns:
        An instance of the model.

    Raises:
        InputError: The content is invalid; the message contains ``where`` and the first wrong key.
    """
    try:
        return model.model_validate(content)
    except ValidationError as error:
        first = error.errors()[0]
    key = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in first["loc"])
    phrases = {"missing": "expected a value; found none", "extra_forbidden": "expected no such key"}
    expected = first["msg"].replace("Input should", "expected to")
    otherwise = f"{expected}; found {reprlib.repr(first['input'])}"
    raise InputError(f"{where}{key}: {phrases.get(first['type'], otherwise)}")


def read_results(path: Path) -> dict[str, Any]:
    """Read a ``metrics.json``.

    Raises:
        InputError: The file is incomplete, has another format version, or its configuration does not
            match its ``config_hash``.
    """
    content = read_json(path, "a metrics.json")
    found = content.get("format_version") if isinstance(content, dict) else type(content).__name__
    if found != FORMAT_VERSION:
        again = "`ghgs evaluate` measures again"
        raise InputError(f"{path}: expected format_version {FORMAT_VERSION}; found {found} ({again})")
    source = validate(_Results, content, str(path)).provenance
    if isinstance(source.get("config"), dict):
        fitting = config_hash(source["config"])
        hashed = source.get("config_hash")
        expected = f"a configuration that fits its config_hash {hashed}"
        require(fitting == hashed, f"{path}: provenance.config", expected, f"one of {fitting}")
    return content


def config_hash(config: Mapping[str, Any], without: Sequence[str] = WITHOUT_INFLUENCE) -> str:
    """Hash of a configuration, independent of the order of its keys.

    Args:
        config: Plain data.
        without: Dotted keys to ignore, including all keys below them.

    Returns:
        Twelve hexadecimal digits.
    """
    hashed = {key: value for key, value in flatten(config).items() if not is_below(key, without)}
    text = json.dumps(hashed, sort_keys=True, separators=(",", ":"), default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def differences(
    before: Mapping[str, Any], now: Mapping[str, Any], without: Sequence[str] = WITHOUT_INFLUENCE
) -> list[str]:
    """Differences between two configurations.

    Args:
        before: Plain data.
        now: Plain data.
        without: Dotted keys to ignore, including all keys below them.

    Returns:
        Lines ``key: old value -> new value``.
    """
    old = flatten(before)
    new = flatten(now)
    keys = (key for key in sorted(old.keys() | new.keys()) if not is_below(key, without))
    return [f"{key}: {old.get(key)} -> {new.get(key)}" for key in keys if old.get(key) != new.get(key)]


def version_of(name: str) -> str | None:
    """Version of an installed distribution; None if it is not installed."""
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None


def versions() -> dict[str, str]:
    """Versions of Python and of the installed packages that affect results."""
    installed = {name: version for name in PACKAGES if (version := version_of(name)) is not None}
    return {"python": platform.python_version(), **installed}


def git_state() -> dict[str, Any] | None:
    """Commit of the checkout and whether tracked files have changed; None outside a checkout."""
    root = Path(__file__).resolve().parents[2]
    if not (root / ".git").exists():
        return None

    command = ["git", "-C", str(root), "describe", "--always", "--exclude=*", "--abbrev=40", "--dirty"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=10, check=True)
    except (OSError, subprocess.SubprocessError):
        return None
    commit, _, changed = done.stdout.strip().partition("-")
    return {"commit": commit, "changed": bool(changed)}


def provenance(config: Mapping[str, Any], **facts: Any) -> dict[str, Any]:
    """Origin of results: configuration with its hash, code, versions, machine and time.

    Args:
        config: Full configuration of the run.
        **facts: Further entries, such as seed, protocol and seconds.

    Returns:
        Plain data for ``metrics.json``.
    """
    return {
        **facts,
        "config_hash": config_hash(config),
        "config": config,
        "git": git_state(),
        "versions": versions(),
        "machine": {"platform": platform.platform(), "processor": platform.machine()},
        "written": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
    }
