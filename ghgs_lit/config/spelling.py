"""Values that spell a whole number in an unusual way stay texts, such as ``2024_05_17`` or ``0426``.

Hydra reads the first as 20240517 and YAML 1.1 the second as octal 278, and the names that were
typed are lost. Keys that are numbers take such texts, too (``10_000``).
"""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import yaml
from hydra.core.override_parser import overrides_parser
from hydra.core.override_parser.overrides_visitor import HydraOverrideVisitor
from omegaconf import _utils

#: Keys of Hydra that are paths and names, whatever they spell.
_PATHS = ("hydra.run.", "hydra.sweep.", "hydra.job.")
#: Functions of overrides whose arguments are numbers.
_OF_NUMBERS = ("range", "interval")

_yaml_loader = _utils.get_yaml_loader


class SpellingVisitor(HydraOverrideVisitor):
    """Hydra's reader of overrides, which keeps spellings."""

    _is_path = False
    _are_numbers = False

    def visitKey(self, ctx: Any) -> Any:
        key = super().visitKey(ctx)
        self._is_path = key.key_or_group.startswith(_PATHS)
        return key

    def visitFunction(self, ctx: Any) -> Any:
        self._are_numbers = ctx.getText().partition("(")[0] in _OF_NUMBERS
        try:
            return super().visitFunction(ctx)
        finally:
            self._are_numbers = False

    def _createPrimitive(self, ctx: Any) -> Any:
        value = super()._createPrimitive(ctx)
        if self._are_numbers or not (type(value) is int or (type(value) is float and self._is_path)):
            return value
        return _spelled(value, ctx.getText().strip())


def yaml_loader() -> type[yaml.SafeLoader]:
    """OmegaConf's reader of YAML, which keeps spellings."""
    loader = _yaml_loader()
    loader.add_constructor("tag:yaml.org,2002:int", _construct_int)
    return loader


def _construct_int(loader: yaml.SafeLoader, node: yaml.ScalarNode) -> int | str:
    return _spelled(loader.construct_yaml_int(node), node.value)


def _spelled(value: float, text: str) -> float | str:
    """A number, or its text where a number is usually written otherwise."""
    return value if str(value) == text.removeprefix("+") else text


def keep_spelling() -> None:
    """Let Hydra and OmegaConf keep spellings in this process from now on."""
    overrides_parser.HydraOverrideVisitor = SpellingVisitor
    _utils.get_yaml_loader = yaml_loader


@contextmanager
def spelling_is_kept() -> Iterator[None]:
    """Keep spellings in the block; other programs' applications do not."""
    before = overrides_parser.HydraOverrideVisitor, _utils.get_yaml_loader
    keep_spelling()
    try:
        yield
    finally:
        overrides_parser.HydraOverrideVisitor, _utils.get_yaml_loader = before
