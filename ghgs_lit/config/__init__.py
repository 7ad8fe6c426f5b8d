"""Where the configuration lies, and how objects are built from it."""

from ghgs_lit.config.build import build
from ghgs_lit.config.paths import conf_dir

__all__ = ["build", "conf_dir"]
