"""Configuration: find and compose its files, and build objects from it."""

from ghgs_lit.config.compose import compose, run_of
from ghgs_lit.config.reading import VERSION_BASE, conf_dir
from ghgs_lit.config.registry import build, register

__all__ = ["VERSION_BASE", "build", "compose", "conf_dir", "register", "run_of"]
