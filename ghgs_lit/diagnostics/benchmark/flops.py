"""Multiplications and additions of the products in each stage, with those of the encoder's compiled kernel.

Element-wise operations, searches and the rasterizer are not counted.
"""

from contextlib import ExitStack
from typing import Any
from unittest import mock

import torch
from torch import Tensor
from torch.utils.flop_counter import FlopCounterMode, sdpa_backward_flop_count, sdpa_flop_count

from ghgs_lit.encoder import cpu
from ghgs_lit.kernels.watching import Inputs, Watcher

#: PyTorch's attention on a CPU, which its own counter does not know.
_CPU_ATTENTION = {
    torch.ops.aten._scaled_dot_product_flash_attention_for_cpu: (
        lambda q, k, v, *_, **__: sdpa_flop_count(q, k, v)
    ),
    torch.ops.aten._scaled_dot_product_flash_attention_for_cpu_backward: (
        lambda gradient, q, k, v, *_, **__: sdpa_backward_flop_count(gradient, q, k, v)
    ),
}


class FlopsProbe(Watcher):
    """A watcher that counts while it is open as a context; ``flops`` has the numbers by stage."""

    def __init__(self) -> None:
        self.flops: dict[str, int] = {}
        self._counter = FlopCounterMode(display=False, custom_mapping=_CPU_ATTENTION)
        self._in_kernel = 0
        self._open: list[int] = []
        self._stack = ExitStack()

    def begin(self, stage: str, inputs: Inputs = ((), {})) -> None:
        self._open.append(self._so_far())

    def end(self, stage: str, result: Any = None) -> None:
        self.flops[stage] = self.flops.get(stage, 0) + self._so_far() - self._open.pop()

    def __enter__(self) -> "FlopsProbe":
        kernel = cpu.attend

        def counting(q: Tensor, k: Tensor, v: Tensor) -> Tensor:
            self._in_kernel += sdpa_flop_count(q.shape, k.shape, v.shape)
            return kernel(q, k, v)

        self._stack.enter_context(self._counter)
        self._stack.enter_context(mock.patch.object(cpu, "attend", counting))
        return self

    def __exit__(self, *details: Any) -> None:
        self._stack.close()

    def _so_far(self) -> int:
        return self._counter.get_total_flops() + self._in_kernel
