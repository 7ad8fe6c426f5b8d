"""In what the configurations of runs differ that stand side by side."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from ghgs_lit.config.keys import WITHOUT_INFLUENCE

# What may differ: how often it was drawn, what the ablation switches, what no number depends on.
_EXPECTED = (
    *WITHOUT_INFLUENCE,
    "seed",
    "ablation",
    "recalibration.neighborhood",
    "recalibration.similarity",
    "views",
    "targets",
    "evaluation",
    "metrics._target_",
)


def _flat(node: Any, key: str = "") -> Iterator[tuple[str, str]]:
    """Dotted keys with their values as text."""
    if isinstance(node, Mapping) and node:
        for name, value in node.items():
            yield from _flat(value, f"{key}.{name}" if key else str(name))
    else:
        yield key, str(node)


def differing(
    configs: Sequence[Mapping[str, Any]], expected: Sequence[str] = _EXPECTED
) -> dict[str, list[str]]:
    """Keys whose values differ among ``configs``, ``expected`` ones (or those below them) left out."""
    flat = [dict(_flat(config)) for config in configs]
    keys = dict.fromkeys(key for values in flat for key in values)
    found = {key: list(dict.fromkeys(values.get(key, "absent") for values in flat)) for key in keys}
    return {
        key: values
        for key, values in found.items()
        if len(values) > 1 and not any(key == e or key.startswith(f"{e}.") for e in expected)
    }


def differing_text(keys: Mapping[str, Sequence[str]], most: int = 6) -> str:
    """``optimizer.lr (0.001, 0.0001)`` and so on, the first ``most`` of them."""
    shown = [f"`{key}` ({', '.join(values[:4])})" for key, values in list(keys.items())[:most]]
    more = len(keys) - len(shown)
    return ", ".join(shown) + (f" and {more} more" if more > 0 else "")
