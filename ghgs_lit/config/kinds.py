"""Kinds of values of a configuration: what is expected, in words and as a test."""

import math
import operator
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

_LIMITS = {
    "least": (">=", operator.ge),
    "most": ("<=", operator.le),
    "above": (">", operator.gt),
    "below": ("<", operator.lt),
}


@dataclass(frozen=True)
class Kind:
    """What a value must be: in words for messages, and as a test. ``a | b`` holds where one of both does."""

    expected: str
    holds: Callable[[Any], bool]

    def __or__(self, other: "Kind") -> "Kind":
        return Kind(
            f"{self.expected} or {other.expected}", lambda value: self.holds(value) or other.holds(value)
        )


def _limited(noun: str, types: type | tuple[type, ...], limits: Mapping[str, float]) -> Kind:
    """A finite number of ``types`` within ``limits`` (names of ``_LIMITS``)."""

    def holds(value: Any) -> bool:
        if not isinstance(value, types) or isinstance(value, bool):
            return False
        finite = isinstance(value, int) or math.isfinite(value)
        return finite and all(_LIMITS[name][1](value, limit) for name, limit in limits.items())

    words = " and ".join(f"{_LIMITS[name][0]} {limit}" for name, limit in limits.items())
    return Kind(f"{noun} {words}".strip(), holds)


def integer(**limits: int) -> Kind:
    """An integer (not true or false) within ``limits``: ``least``, ``most``, ``above``, ``below``."""
    return _limited("an integer", int, limits)


def number(**limits: float) -> Kind:
    """A finite number (not true or false) within ``limits``, as for :func:`integer`."""
    return _limited("a number", (int, float), limits)


def one_of(*names: str | int) -> Kind:
    """One of ``names``."""
    words = "one of " * (len(names) > 1) + ", ".join(map(str, names))
    return Kind(words, lambda value: not isinstance(value, bool) and value in names)


def list_of(kind: Kind, length: int | None = None) -> Kind:
    """A list of ``length`` (None: any) values, each of ``kind``."""
    return Kind(
        f"a list{'' if length is None else f' of {length} values'} (each {kind.expected})",
        lambda value: (
            isinstance(value, list) and length in (None, len(value)) and all(map(kind.holds, value))
        ),
    )


def mapping_of(**kinds: Kind) -> Kind:
    """A mapping with exactly these keys."""
    words = ", ".join(f"{name}: {kind.expected}" for name, kind in kinds.items())
    return Kind(
        f"a mapping ({words})",
        lambda value: (
            isinstance(value, Mapping)
            and set(value) == set(kinds)
            and all(kind.holds(value[name]) for name, kind in kinds.items())
        ),
    )


def text_like(pattern: str, expected: str) -> Kind:
    """A text that matches the regular expression ``pattern`` as a whole."""
    return Kind(expected, lambda value: isinstance(value, str) and re.fullmatch(pattern, value) is not None)


NULL = Kind("null", lambda value: value is None)
FLAG = Kind("true or false", lambda value: isinstance(value, bool))
TEXT = Kind("a text", lambda value: isinstance(value, str) and value != "")
PATH = Kind("a path", TEXT.holds) | NULL
COUNT = integer(least=1)
AMOUNT = number(least=0)
POSITIVE = number(above=0)
SHARE = number(least=0, most=1)
SEED = integer(least=0, most=2**32 - 1)
TEXTS = list_of(TEXT)
POSITIONS = list_of(integer(least=0))
WORKERS = integer(least=0, most=1024)
# A photograph of more pixels would need gigabytes before anything could refuse it.
SIDE = integer(least=1, most=8192)
SIZE = SIDE | list_of(SIDE, 2)
WIDTH = integer(least=1, most=65536)
FRAMES = list_of(integer(least=0), 3)
