"""Multiplications and additions of the products in each stage, with those of the compiled kernels.

Element-wise operations, searches and the rasterizer are not counted.
"""

import math
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from types import ModuleType
from typing import Any

import torch
from torch import Tensor
from torch.utils.flop_counter import FlopCounterMode, sdpa_backward_flop_count, sdpa_flop_count

from ghgs_lit import encoder


def _attention(q: Tensor, k: Tensor, v: Tensor) -> int:
    return 4 * math.prod(q.shape) * k.shape[-2]


#: Compiled kernels, which PyTorch cannot see: module, function, FLOPs from its arguments.
KERNELS: tuple[tuple[ModuleType, str, Callable[..., int]], ...] = ((encoder.cpu, "attend", _attention),)


def _cpu_attention(query: tuple, key: tuple, value: tuple, *_: Any, **__: Any) -> int:
    return sdpa_flop_count(query, key, value)


def _cpu_attention_backward(
    gradient: tuple, query: tuple, key: tuple, value: tuple, *_: Any, **__: Any
) -> int:
    return sdpa_backward_flop_count(gradient, query, key, value)


#: PyTorch's attention on a CPU, which its own counter does not know.
_UNKNOWN = {
    torch.ops.aten._scaled_dot_product_flash_attention_for_cpu: _cpu_attention,
    torch.ops.aten._scaled_dot_product_flash_attention_for_cpu_backward: _cpu_attention_backward,
}


class FlopsProbe:
    """A probe (:mod:`ghgs_lit.diagnostics.benchmark.stages`) that counts; ``flops`` has the numbers by stage.

    It counts while it is open as a context.
    """

    def __init__(self) -> None:
        self.flops: dict[str, int] = {}
        self._counter = FlopCounterMode(display=False, custom_mapping=_UNKNOWN)
        self._kernels = 0
        self._open: list[int] = []
        self._stack = ExitStack()

    def begin(self, stage: str) -> None:
        self._open.append(self._so_far())

    def end(self, stage: str) -> None:
        self.flops[stage] = self.flops.get(stage, 0) + self._so_far() - self._open.pop()

    def __enter__(self) -> "FlopsProbe":
        self._stack.enter_context(self._counter)
        for module, name, count in KERNELS:
            self._stack.enter_context(self._counted(module, name, count))
        return self

    def __exit__(self, *details: Any) -> None:
        self._stack.close()

    def _so_far(self) -> int:
        return self._counter.get_total_flops() + self._kernels

    @contextmanager
    def _counted(self, module: ModuleType, name: str, count: Callable[..., int]) -> Iterator[None]:
        kernel = getattr(module, name)

        def counting(*arguments: Any) -> Any:
            self._kernels += count(*arguments)
            return kernel(*arguments)

        setattr(module, name, counting)
        try:
            yield
        finally:
            setattr(module, name, kernel)
