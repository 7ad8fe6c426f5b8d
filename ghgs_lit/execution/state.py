"""State that a captured graph depends on besides its inputs: weights and settings of a model."""

from collections.abc import Hashable
from dataclasses import dataclass
from typing import Any, NamedTuple

from torch import nn
from torch.nn.modules import module as torch_module

from ghgs_lit.execution.capture import NotCapturable
from ghgs_lit.runtime.watching import Wrapped

_SIMPLE = (str, int, float, bool, type(None))
#: Attributes that every module has.
_COMMON = frozenset(vars(nn.Module())) - {"training"}
_HOOKS = ("_forward_hooks", "_forward_pre_hooks", "_backward_hooks", "_backward_pre_hooks")


class ModelState(NamedTuple):
    """Weights and settings that a model's computation depends on.

    Attributes:
        weights: identity and address of all parameters and buffers.
        settings: all other attributes, by stage.
    """

    weights: tuple
    settings: tuple[tuple[str, tuple], ...]

    @property
    def encoder(self) -> tuple:
        """Settings of the encoder."""
        return dict(self.settings)["encoder"]


@dataclass(frozen=True, eq=False)
class Same:
    """Compares an object by identity, and keeps it alive."""

    value: Any

    def __hash__(self) -> int:
        return id(self.value)

    def __eq__(self, other: Any) -> bool:
        return isinstance(other, Same) and self.value is other.value


def state_of(model: nn.Module) -> ModelState:
    """Get the state of a model to be captured.

    Raises:
        NotCapturable: a module has hooks or a replaced method.
    """
    if torch_module._has_any_global_hook():
        raise NotCapturable("hooks of all modules")
    weights: list[Hashable] = []
    stages: dict[str, list[Hashable]] = {}
    for name, part in model.named_modules():
        values = vars(part)
        if any(values[hooks] for hooks in _HOOKS):
            raise NotCapturable(f"a hook of {name or 'the model'}")
        settings = stages.setdefault(name.partition(".")[0], [])
        settings.append(Same(part))
        for attribute, value in values.items():
            if attribute in _COMMON:
                continue
            if isinstance(value, Wrapped) or (callable(value) and hasattr(type(part), attribute)):
                raise NotCapturable(f"{f'{name}.' * bool(name)}{attribute} is replaced")
            settings.append((attribute, _key(value)))
        for tensor in (*part._parameters.values(), *part._buffers.values()):
            if tensor is not None:
                weights.append((id(tensor), tensor.data_ptr()))
    return ModelState(tuple(weights), tuple((name, tuple(values)) for name, values in stages.items()))


def _key(value: Any, is_whole: bool = True) -> Hashable:
    """Key of an attribute's value that is equal for equal settings; ``is_whole``: includes attributes of
    an object."""
    if isinstance(value, _SIMPLE):
        return value
    if isinstance(value, (tuple, list)):
        return tuple(_key(item, False) for item in value)
    if isinstance(value, dict):
        return tuple((key, _key(item, False)) for key, item in value.items())
    if is_whole and hasattr(value, "__dict__"):
        return Same(value), _key(vars(value))
    return Same(value)
