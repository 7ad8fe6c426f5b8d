"""Provenance of results: configuration, code, versions, machine."""

import datetime
import hashlib
import importlib.metadata
import json
import platform
import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ghgs_lit.config.keys import WITHOUT_INFLUENCE, flatten, is_below

PACKAGES = ("ghgs-lit", "torch", "lightning", "torchmetrics", "kornia", "numpy", "scipy", "gsplat")


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
