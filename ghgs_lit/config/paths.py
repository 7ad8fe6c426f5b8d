"""Finds the Hydra configuration of the installed package or of the checkout."""

from pathlib import Path
from typing import Any

import hydra

from ghgs_lit.errors import InputError

#: How Hydra is to behave: Hydra 1.3 asks, later ones no longer do.
VERSION_BASE: dict[str, Any] = {"version_base": "1.3"} if hydra.__version__.startswith("1.3") else {}


def conf_dir() -> Path:
    """Absolute path of ``conf``: inside the package in a wheel, beside it in a checkout."""
    package = Path(__file__).resolve().parents[1]
    candidates = (package / "conf", package.parent / "conf")
    for candidate in candidates:
        if (candidate / "train.yaml").is_file():
            return candidate
    raise InputError(
        f"configuration: expected train.yaml in one of {', '.join(map(str, candidates))}; found none"
    )
