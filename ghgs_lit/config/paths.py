"""Finds the Hydra configuration of the installed package or of the checkout."""

from pathlib import Path

import ghgs_lit
from ghgs_lit.errors import InputError


def conf_dir() -> Path:
    """Absolute path of ``conf``: inside the package in a wheel, beside it in a checkout."""
    package = Path(ghgs_lit.__file__).resolve().parent
    candidates = (package / "conf", package.parent / "conf")
    for candidate in candidates:
        if (candidate / "train.yaml").is_file():
            return candidate
    raise InputError(
        f"configuration: expected train.yaml in one of {', '.join(map(str, candidates))}; found none"
    )
