"""The user's own code: modules that register kinds of options (:mod:`ghgs_lit.config.registry`).

A configuration can come from somebody else's checkpoint, so it cannot name modules itself. The user does,
with ``GHGS_PLUGINS`` in the environment (Python files or names of modules, separated as in ``PATH``), or by
installing a package that declares an entry point in the group ``ghgs_lit.plugins``.
"""

import gc
import importlib
import importlib.metadata
import importlib.util
import os
import sys
from functools import cache
from pathlib import Path

from ghgs_lit.errors import InputError

VARIABLE, GROUP = "GHGS_PLUGINS", "ghgs_lit.plugins"


def load_plugins() -> None:
    """Import the modules that the user names, so that they register their kinds. InputError: a file is
    missing, or another module has its name. Errors inside a module keep their type."""
    names = [_module_of(entry) for entry in os.environ.get(VARIABLE, "").split(os.pathsep) if entry.strip()]
    for name in (*names, *_installed()):
        # The command line freezes what is imported while it is off: open files would not be flushed at exit.
        gc.enable()
        importlib.import_module(name)


@cache
def _installed() -> tuple[str, ...]:
    """Modules of installed packages that declare the entry point."""
    return tuple(point.value for point in importlib.metadata.entry_points(group=GROUP))


def _module_of(entry: str) -> str:
    """The name of the module; a file becomes importable by its stem. InputError: the file is missing, or
    another module has its name."""
    entry = entry.strip()
    if not entry.endswith(".py"):
        return entry
    path = Path(entry).expanduser().resolve()
    if not path.is_file():
        raise InputError(f"{VARIABLE}: expected a Python file; found no {path}")
    if not path.stem.isidentifier():
        raise InputError(f"{VARIABLE}: expected a file name that Python can import; found {path.name!r}")
    folder = str(path.parent)
    if folder not in sys.path:
        # Last in the search path: the file's neighbours must not hide installed packages.
        sys.path.append(folder)
        importlib.invalidate_caches()
    spec = importlib.util.find_spec(path.stem)
    if spec is None or spec.origin is None or Path(spec.origin).resolve() != path:
        found = spec.origin if spec else "none"
        raise InputError(f"{VARIABLE}: expected a name that no other module has for {path}; found {found}")
    return path.stem
