"""The configuration: where its files are, how it is composed, and how objects are built from it."""

from ghgs_lit.config.compose import VERSION_BASE, compose, conf_dir, resolve
from ghgs_lit.config.registry import build, register

__all__ = ["VERSION_BASE", "build", "compose", "conf_dir", "register", "resolve"]
