"""``metrics.json`` and ``metrics.csv``: one row for each subject, target and method, with their
provenance: configuration, code, versions, machine."""

import csv
import datetime
import hashlib
import importlib.metadata
import io
import itertools
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

FORMAT_VERSION = 3  #: The version that is written, and the only one that is read
METHOD = "model"  #: Method of a trained model's rows; others are baselines
KEYS = ("method", "subject", "views", "targets", "target", "inputs", "skip")
"""What a row describes; all other entries of a row are metrics."""

PACKAGES = ("ghgs-lit", "torch", "lightning", "torchmetrics", "kornia", "numpy", "scipy", "gsplat")
Row = dict[str, Any]
Model = TypeVar("Model", bound=BaseModel)


def mean(values: Iterable[float | None]) -> float | None:
    """Mean of the values that are neither None nor nan.

    Args:
        values: Numbers or None.

    Returns:
        The mean; None without any value.
    """
    known = [v for v in values if v is not None and not math.isnan(v)]
    return sum(known) / len(known) if known else None


def metric_names(rows: Sequence[Row]) -> list[str]:
    """Names of the metrics in rows.

    Args:
        rows: Of a measurement.

    Returns:
        Names in order of appearance.
    """
    names = dict.fromkeys(itertools.chain.from_iterable(rows))
    return [name for name in names if name not in KEYS]


def by_protocol(rows: Sequence[Row]) -> dict[tuple, dict[str, list[Row]]]:
    """Rows of each method on each protocol.

    Args:
        rows: Of a measurement.

    Returns:
        Rows by (method, views, targets), then by subject.
    """
    groups: dict[tuple, dict[str, list[Row]]] = {}
    for row in rows:
        key = (row["method"], row["views"], row["targets"])
        groups.setdefault(key, {}).setdefault(row["subject"], []).append(row)
    return groups


def summarize(rows: Sequence[Row]) -> list[Row]:
    """Means over subjects for each method, number of views and target protocol. A subject's targets
    are averaged first, so that each subject counts once.

    Args:
        rows: Of a measurement.

    Returns:
        One row for each, with the number of ``subjects`` and the means.
    """
    names = metric_names(rows)
    summary = []
    for (method, views, targets), subjects in by_protocol(rows).items():
        entry = {"method": method, "views": views, "targets": targets, "subjects": len(subjects)}
        for name in names:
            of_subjects = []
            for of_one in subjects.values():
                of_subjects.append(mean(row.get(name) for row in of_one))
            entry[name] = mean(of_subjects)
        summary.append(entry)
    return summary


def plain(value: Any) -> Any:
    """A value as plain data for JSON.

    Args:
        value: Mappings, lists, tuples, texts, numbers.

    Returns:
        The same with keys of text; infinite numbers and nan become None.
    """
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, Mapping):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(v) for v in value]
    return value


def write_results(directory: Path, rows: Sequence[Row], provenance: Mapping[str, Any]) -> Path:
    """Write ``metrics.csv``, then ``metrics.json``, which marks the run as complete.

    Args:
        directory: Of the run.
        rows: Of its measurement.
        provenance: As of :func:`provenance`.

    Returns:
        Path of ``metrics.json``.

    Raises:
        InputError: There are no rows.
    """
    if not rows:
        raise InputError("evaluation: expected at least one subject and target; found none")
    # Columns that distinguish the rows of concatenated tables.
    origin = {
        "data": provenance.get("data", {}).get("name"),
        "split": provenance.get("data", {}).get("split"),
        "protocol": provenance.get("protocol", {}).get("metrics"),
        "seed": provenance.get("seed"),
        "config_hash": provenance.get("config_hash"),
    }
    known = set().union(*rows)
    columns = [*(key for key in KEYS if key in known), *metric_names(rows), *origin]
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


class _Mean(BaseModel):
    """An entry of ``summary``; all further keys are metrics."""

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


def validated(model: type[Model], content: Any, where: str) -> Model:
    """Check content by a pydantic model.

    Args:
        model: What is expected.
        content: Plain data.
        where: What it is, for messages.

    Returns:
        The content as the model.

    Raises:
        InputError: Names ``where`` and the first wrong key.
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

    Args:
        path: Of the file.

    Returns:
        Its content.

    Raises:
        InputError: It is not complete or of another format version, or its configuration does not
            fit its ``config_hash``.
    """
    content = read_json(path, "a metrics.json")
    found = content.get("format_version") if isinstance(content, dict) else type(content).__name__
    if found != FORMAT_VERSION:
        again = "`ghgs evaluate` measures again"
        raise InputError(f"{path}: expected format_version {FORMAT_VERSION}; found {found} ({again})")
    source = validated(_Results, content, str(path)).provenance
    if isinstance(source.get("config"), dict):
        fitting = config_hash(source["config"])
        hashed = source.get("config_hash")
        expected = f"a configuration that fits its config_hash {hashed}"
        require(fitting == hashed, f"{path}: provenance.config", expected, f"one of {fitting}")
    return content


def config_hash(config: Mapping[str, Any], without: Sequence[str] = WITHOUT_INFLUENCE) -> str:
    """Hash of a configuration, whatever the order of its keys.

    Args:
        config: Plain data.
        without: Dotted keys that do not count, with those below them.

    Returns:
        Twelve hexadecimal digits.
    """
    hashed = {key: value for key, value in flatten(config).items() if not is_below(key, without)}
    text = json.dumps(hashed, sort_keys=True, separators=(",", ":"), default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def differences(
    before: Mapping[str, Any], now: Mapping[str, Any], without: Sequence[str] = WITHOUT_INFLUENCE
) -> list[str]:
    """What differs between configurations.

    Args:
        before: Plain data.
        now: Plain data.
        without: Dotted keys that do not count, with those below them.

    Returns:
        Lines ``key: old value -> new value``.
    """
    old = flatten(before)
    new = flatten(now)
    keys = (key for key in sorted(old.keys() | new.keys()) if not is_below(key, without))
    return [f"{key}: {old.get(key)} -> {new.get(key)}" for key in keys if old.get(key) != new.get(key)]


def version_of(name: str) -> str | None:
    """Version of a package.

    Args:
        name: Of the distribution.

    Returns:
        The version; None: it is not installed.
    """
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None


def versions() -> dict[str, str]:
    """Versions of Python and of the installed packages that results depend on."""
    installed = {name: version for name in PACKAGES if (version := version_of(name)) is not None}
    return {"python": platform.python_version(), **installed}


def git_state() -> dict[str, Any] | None:
    """Commit of the checkout and whether tracked files were changed; None outside of a checkout."""
    root = Path(__file__).resolve().parents[2]
    if not (root / ".git").exists():
        return None

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(root), *arguments]
        return subprocess.run(command, capture_output=True, text=True, timeout=10, check=True).stdout.strip()

    try:
        return {
            "commit": git("rev-parse", "HEAD"),
            "changed": bool(git("status", "--porcelain", "--untracked-files=no")),
        }
    except (OSError, subprocess.SubprocessError):
        return None


def provenance(config: Mapping[str, Any], **facts: Any) -> dict[str, Any]:
    """Where results come from: configuration with its hash, code, versions, machine and time.

    Args:
        config: The run's full configuration.
        **facts: Of the verb, such as seed, protocol and seconds.

    Returns:
        Plain data for a results file.
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
