"""The configuration: where its files are, how it is composed, and how objects are built from it."""

from ghgs_lit.config.build import build
from ghgs_lit.config.compose import compose, resolve
from ghgs_lit.config.paths import conf_dir

__all__ = ["build", "compose", "conf_dir", "resolve"]
