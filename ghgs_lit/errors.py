"""Errors that a user can correct; the command line prints them in one line and exits with 1."""

import importlib
from types import ModuleType


class InputError(ValueError):
    """Bad input; the message names the path or key, the expectation and the value."""


def require_choice(key: str, value: object, allowed: tuple) -> None:
    """Reject a value of a configuration key that is not among those allowed.

    Args:
        key: dotted key, for the message.
        value: the configured value.
        allowed: all allowed values.

    Raises:
        InputError: names the key, all allowed values and ``value``.
    """
    if value not in allowed:
        raise InputError(
            f"{key}: expected one of {', '.join(map(str, allowed))}; found {format_value(value)}"
        )


def require(condition: bool, key: str, expected: str, found: object) -> None:
    """Reject the value of a path or key unless a condition holds.

    Args:
        condition: whether the value is valid.
        key: path or dotted key of the value.
        expected: a valid value, in words.
        found: the value, formatted by :func:`format_value`.

    Raises:
        InputError: "<key>: expected <expected>; found <found>".
    """
    if not condition:
        raise InputError(f"{key}: expected {expected}; found {format_value(found)}")


def format_value(value: object) -> str:
    """Format a value for a message by ``repr``, except integers of more than 4300 digits, where it
    fails."""
    try:
        return repr(value)
    except ValueError:
        return f"a {type(value).__name__} that is too long to show"


def import_optional(package: str, extra: str, key: str) -> ModuleType:
    """Import an optional dependency, which an extra of this package installs.

    Args:
        package: name of the module.
        extra: name of the extra, for the command in the message.
        key: dotted key that requires the package, for the message.

    Raises:
        InputError: the package cannot be imported; the message contains the command that installs it.
    """
    try:
        return importlib.import_module(package)
    except ImportError:
        hint = f"pip install 'ghgs-lit[{extra}]'"
        raise InputError(f"{key}: expected the package {package} ({hint}); found none") from None
