"""Where a number comes from: configuration, code, versions, machine."""

import datetime
import hashlib
import importlib.metadata
import json
import platform
import subprocess
from collections.abc import Mapping
from pathlib import Path
from typing import Any

PACKAGES = ("ghgs-lit", "torch", "lightning", "torchmetrics", "kornia", "numpy", "scipy", "gsplat")

# Where a run writes, what it shows and how it shares the machine: no number depends on these.
UNHASHED = frozenset(
    {
        "dry_run",
        "resume",
        "logger",
        "callbacks",
        "data.cache_dir",
        "data.cache_images_mb",
        "data.pin_memory",
        "data.render_workers",
        "data.workers",
        "encoder.weights",  # said of init_from's, which counts
        "evaluation.pictures",
        "trainer.log_every_n_steps",
    }
)


def config_hash(config: Mapping[str, Any]) -> str:
    """Twelve hexadecimal digits that stand for a resolved configuration; the order of keys is no matter.

    What no number depends on (``UNHASHED``) has no part in it.
    """

    def hashed(node: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
        return {
            key: hashed(value, f"{prefix}{key}.") if isinstance(value, Mapping) else value
            for key, value in node.items()
            if f"{prefix}{key}" not in UNHASHED
        }

    text = json.dumps(hashed(config), sort_keys=True, separators=(",", ":"), default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def versions() -> dict[str, str]:
    """Versions of Python and of the installed packages that numbers depend on."""
    found = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return found


def git_state() -> dict[str, Any] | None:
    """Commit of the checkout that the package runs from and whether it was changed; None outside of one."""
    root = Path(__file__).resolve().parents[2]
    if not (root / ".git").exists():
        return None

    def git(*arguments: str) -> str:
        done = subprocess.run(
            ["git", "-C", str(root), *arguments], capture_output=True, text=True, timeout=10
        )
        done.check_returncode()
        return done.stdout.strip()

    try:
        return {
            "commit": git("rev-parse", "HEAD"),
            "changed": bool(git("status", "--porcelain", "--untracked-files=no")),
        }
    except (OSError, subprocess.SubprocessError):
        return None


def provenance(config: Mapping[str, Any], **facts: Any) -> dict[str, Any]:
    """All of it as plain data; ``facts`` are what the verb knows (seed, protocol, parameters, seconds)."""
    return {
        **facts,
        "config_hash": config_hash(config),
        "config": config,
        "git": git_state(),
        "versions": versions(),
        "machine": {"platform": platform.platform(), "processor": platform.machine()},
        "written": datetime.datetime.now(datetime.timezone.utc).isoformat(timespec="seconds"),
    }
