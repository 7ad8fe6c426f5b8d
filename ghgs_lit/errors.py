"""Errors that a user can correct; the command line prints them as one line and exits with 1."""

import importlib
from types import ModuleType


class InputError(ValueError):
    """Bad input; the message names the path or key, what was expected and what was found."""


def choice(key: str, value: object, allowed: tuple) -> None:
    """Refuse the ``value`` of a configuration's ``key`` unless it is one of ``allowed``."""
    if value not in allowed:
        raise InputError(f"{key}: expected one of {', '.join(map(str, allowed))}; found {shown(value)}")


def require(condition: bool, key: str, expected: str, found: object) -> None:
    """Refuse the value ``found`` of ``key`` unless ``condition`` holds; ``expected`` describes it."""
    if not condition:
        raise InputError(f"{key}: expected {expected}; found {shown(found)}")


def shown(value: object) -> str:
    """A value in a message: as Python writes it, if it can (numbers of more than 4300 digits it cannot)."""
    try:
        return repr(value)
    except ValueError:
        return f"a {type(value).__name__} that is too long to show"


def installed(package: str, extra: str, key: str) -> ModuleType:
    """Import a package that an ``extra`` installs and ``key`` needs. InputError: it is missing."""
    try:
        return importlib.import_module(package)
    except ImportError:
        hint = f"pip install 'ghgs-lit[{extra}]'"
        raise InputError(f"{key}: expected the package {package} ({hint}); found none") from None
