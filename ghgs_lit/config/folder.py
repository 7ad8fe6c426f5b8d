"""Folder of the package's configuration files."""

from pathlib import Path
from typing import Any

import hydra

from ghgs_lit.errors import InputError

#: Hydra 1.3 requires the version to be compatible with; later versions do not accept it.
VERSION_BASE: dict[str, Any] = {"version_base": "1.3"} if hydra.__version__.startswith("1.3") else {}


def conf_dir() -> Path:
    """Absolute path of ``conf``: inside the package in a wheel, next to it in a checkout.

    Raises:
        InputError: Neither folder exists.
    """
    package = Path(__file__).resolve().parents[1]
    candidates = (package / "conf", package.parent / "conf")
    for candidate in candidates:
        if (candidate / "train.yaml").is_file():
            return candidate
    raise InputError(
        f"configuration: expected train.yaml in one of {', '.join(map(str, candidates))}; found none"
    )
