"""The settings in which runs differ that stand side by side in a table."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from ghgs_lit.config.keys import EXPECTED_TO_DIFFER, flatten, is_below


def differing(configs: Sequence[Mapping[str, Any]]) -> dict[str, list[str]]:
    """Keys whose values differ among ``configs`` with these values, without those expected to differ."""
    flat = [flatten(config) for config in configs]
    keys = dict.fromkeys(key for values in flat for key in values)
    found = {key: list(dict.fromkeys(str(values.get(key, "absent")) for values in flat)) for key in keys}
    return {
        key: values
        for key, values in found.items()
        if len(values) > 1 and not is_below(key, EXPECTED_TO_DIFFER)
    }


def differing_text(keys: Mapping[str, Sequence[str]], limit: int = 6) -> str:
    """``optimizer.lr (0.001, 0.0001)`` and so on, the first ``limit`` keys."""
    shown = [f"`{key}` ({', '.join(values[:4])})" for key, values in list(keys.items())[:limit]]
    more = len(keys) - len(shown)
    return ", ".join(shown) + (f" and {more} more" if more > 0 else "")


def telling_apart(configs: Sequence[Mapping[str, Any]], keys: Mapping[str, Sequence[str]]) -> Iterable[str]:
    """One of the ``keys`` in which ``configs`` differ if it tells all of them apart, else all."""
    return next(([key] for key, values in keys.items() if len(values) == len(configs)), list(keys))
