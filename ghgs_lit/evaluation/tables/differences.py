"""What the configurations of runs differ in."""

import itertools
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from ghgs_lit.config.keys import EXPECTED_TO_DIFFER, OF_A_PLACE, OF_A_RUN, flatten, is_below
from ghgs_lit.runs.provenance import config_hash

ABSENT = "absent"
"""Text of a value that a configuration does not have."""


def differing(
    configs: Sequence[Mapping[str, Any]], expected: Iterable[str] = EXPECTED_TO_DIFFER
) -> dict[str, list[str]]:
    """Keys in which configurations differ.

    Args:
        configs: Of several runs.
        expected: Keys that may differ, with those below them.

    Returns:
        Dotted keys with their values as text, ``ABSENT`` among them.
    """
    flat = [flatten(config) for config in configs]
    keys = dict.fromkeys(itertools.chain.from_iterable(flat))
    known = [key for key in keys if not is_below(key, expected)]
    texts = {}
    for key in known:
        texts[key] = list(dict.fromkeys(str(values.get(key, ABSENT)) for values in flat))
    return {key: values for key, values in texts.items() if len(values) > 1}


def differing_text(keys: Mapping[str, Sequence[str]], limit: int = 6) -> str:
    """What configurations differ in, for messages.

    Args:
        keys: As of :func:`differing`.
        limit: Number of keys that are shown; of each four values.

    Returns:
        Text such as ``optimizer.lr (0.001, 0.0001)``.
    """
    shown = [f"`{key}` ({', '.join(values[:4])})" for key, values in list(keys.items())[:limit]]
    more = len(keys) - len(shown)
    return ", ".join(shown) + (f" and {more} more" if more > 0 else "")


def telling_apart(configs: Sequence[Mapping[str, Any]], keys: Mapping[str, Sequence[str]]) -> Iterable[str]:
    """Keys that are enough to distinguish configurations.

    Args:
        configs: Of several runs, some of which may be equal.
        keys: As of :func:`differing`.

    Returns:
        The first key whose values distinguish all that are different, else all keys.
    """
    count = len({config_hash(config, (*OF_A_RUN, *OF_A_PLACE)) for config in configs})
    return next(([key] for key, values in keys.items() if len(values) == count), list(keys))
