"""A stand-in for CUDA graphs that repeats the operators of a call in the memory of the captured one."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from tests.helpers.pretend_device import DEVICE, PretendTensor


class OperatorBackend:
    """Like CUDA graphs, for devices of type ``device``; ``recorded``: number of operators of each capture."""

    def __init__(self, device: str = DEVICE.type):
        self.device = device
        self.recorded: list[int] = []

    def capture(self, call: Callable[[], Any]) -> tuple[Any, Callable[[], None]]:
        call()  # CUDA graphs require a warm-up with the same inputs
        with _Operators() as operators:
            result = call()
        self.recorded.append(len(operators.calls))
        return result, operators.play


class SilentBackend(OperatorBackend):
    """Replays do nothing on the host."""

    def capture(self, call: Callable[[], Any]) -> tuple[Any, Callable[[], None]]:
        return call(), lambda: None


class _Operators(TorchDispatchMode):
    def __init__(self):
        super().__init__()
        self.calls = []

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        result = function(*args, **(kwargs or {}))
        self.calls.append((function, args, kwargs or {}, result))
        return result

    @torch.no_grad()
    def play(self) -> None:
        for function, args, kwargs, result in self.calls:
            again = function(*args, **kwargs)
            if any(value.alias_info is not None for value in function._schema.returns):
                continue  # a view, or an output that was written in place
            for old, new in zip(_of(result), _of(again), strict=True):
                old.copy_(new)


def _of(result: Any) -> list[Tensor]:
    """Values of a result's tensors, on the CPU."""
    tensors = [leaf for leaf in tree_leaves(result) if isinstance(leaf, Tensor)]
    return [tensor.inner if isinstance(tensor, PretendTensor) else tensor for tensor in tensors]
