"""Configuration values that are checked when they are read."""

import difflib
from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any, TypeVar

from ghgs_lit.errors import InputError, require

_S = TypeVar("_S")


def from_config(cls: type[_S], key: str, values: _S | Mapping[str, Any]) -> _S:
    """Build the settings dataclass ``cls`` from a mapping.

    Args:
        cls: a dataclass with one field for each key.
        key: dotted key of the mapping, for messages.
        values: the mapping, or an instance of ``cls``, which is returned as it is.

    Raises:
        InputError: a key that ``cls`` does not have.
    """
    return values if isinstance(values, cls) else from_flat(key, cls.__name__, values, cls)[0]


def from_flat(key: str, owner: str, values: Mapping[str, Any], *classes: type) -> list[Any]:
    """Build several settings dataclasses from one flat mapping, each from the keys that are its fields.

    Args:
        key: dotted key of the mapping, for messages.
        owner: name of the class that is configured, for messages.
        values: the mapping.
        classes: dataclasses without common fields.

    Raises:
        InputError: a key that is a field of none of them.
    """
    require(isinstance(values, Mapping), key, f"a mapping of the settings of {owner}", values)
    known = [{f.name for f in fields(cls) if f.init} for cls in classes]
    everything = sorted(set().union(*known))
    for name in values:
        if name not in everything:
            close = difflib.get_close_matches(str(name), everything, 1)
            hint = f" (did you mean {close[0]}?)" if close else ""
            raise InputError(
                f"{key} key: expected one of {', '.join(everything)} for {owner}; found {name!r}{hint}"
            )
    return [
        cls(**{name: value for name, value in values.items() if name in names})
        for cls, names in zip(classes, known, strict=True)
    ]


def set_fields(instance: Any, **values: Any) -> None:
    """Set fields of a frozen dataclass, in its ``__post_init__``."""
    for name, value in values.items():
        object.__setattr__(instance, name, value)


def image_size(key: str, size: int | Sequence[int]) -> tuple[int, int]:
    """(height, width) in pixels from a side or a pair."""
    pair = (size, size) if isinstance(size, int) else tuple(size)
    valid = len(pair) == 2 and all(isinstance(side, int) and side >= 1 for side in pair)
    require(valid, key, "a side or [height, width] in pixels", size)
    return pair
