"""Configuration values that are checked when they are read."""

from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any, TypeVar

from ghgs_lit.errors import choice, require

_S = TypeVar("_S")


def from_config(cls: type[_S], key: str, values: _S | Mapping[str, Any]) -> _S:
    """Build the settings ``cls`` from the mapping at ``key``; a misspelt key is an error that names it."""
    if isinstance(values, cls):
        return values
    known = {f.name for f in fields(cls)}
    for name in values:
        choice(f"{key} key", name, tuple(sorted(known)))
    return cls(**values)


def image_size(key: str, size: int | Sequence[int]) -> tuple[int, int]:
    """(height, width) of a side or a pair."""
    pair = (size, size) if isinstance(size, int) else tuple(size)
    valid = len(pair) == 2 and all(isinstance(side, int) and side >= 1 for side in pair)
    require(valid, key, "a side or [height, width] in pixels", size)
    return pair
