"""Errors that a user can correct; the command line prints them as one line and exits with 1."""

import importlib
from types import ModuleType


class InputError(ValueError):
    """Bad input; the message names the path or key, what was expected and what was found."""


def choice(key: str, value: object, allowed: tuple) -> None:
    """Refuse the value of a configuration's key unless it is one of those allowed.

    Args:
        key: dotted key, for the message.
        value: what the key holds.
        allowed: all values that the key may hold.

    Raises:
        InputError: names the key, all allowed values and ``value``.
    """
    if value not in allowed:
        raise InputError(f"{key}: expected one of {', '.join(map(str, allowed))}; found {shown(value)}")


def require(condition: bool, key: str, expected: str, found: object) -> None:
    """Refuse the value of a path or key unless a condition holds.

    Args:
        condition: whether the value is good.
        key: path or dotted key that has the value.
        expected: what would be good, in words.
        found: the value, shown by :func:`shown`.

    Raises:
        InputError: "<key>: expected <expected>; found <found>".
    """
    if not condition:
        raise InputError(f"{key}: expected {expected}; found {shown(found)}")


def shown(value: object) -> str:
    """A value in a message: as Python writes it,
    if it can (numbers of more than 4300 digits it cannot)."""
    try:
        return repr(value)
    except ValueError:
        return f"a {type(value).__name__} that is too long to show"


def installed(package: str, extra: str, key: str) -> ModuleType:
    """Import a package that an extra of this one installs.

    Args:
        package: name of the module.
        extra: name of the extra, for the command in the message.
        key: dotted key that needs the package, for the message.

    Raises:
        InputError: the package cannot be imported; the message contains the command that installs it.
    """
    try:
        return importlib.import_module(package)
    except ImportError:
        hint = f"pip install 'ghgs-lit[{extra}]'"
        raise InputError(f"{key}: expected the package {package} ({hint}); found none") from None
