"""The small networks of a Gaussian's attributes, distributed over threads."""

from functools import partial

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from ghgs_lit.kernels import pool
from ghgs_lit.kernels.parts import even_parts

#: Rows of one task, and how many of the pool's pieces of work one of them is.
_TASK, _WORK = 1024, 2
#: Rows of one task of the gradients: each adds up sums of its own.
_LEARNED = 2048


def attributes(
    networks: list[nn.Sequential], descriptors: Float[Tensor, "*n c"]
) -> tuple[Float[Tensor, "*n _"], ...]:
    """What each of the networks makes of the descriptors; see :func:`ghgs_lit.kernels.pool.multiplies`.

    Args:
        networks: of three layers, of equal widths but for the last, with ``nn.Tanh`` or ``nn.ReLU`` between.
        descriptors: of pixels.
    """
    from ghgs_lit.kernels.layers import parameters  # here, like the kernels: it loads a compiler

    numbers = parameters([layer for network in networks for layer in network])
    outputs = [len(network[4].bias) for network in networks]
    widths = np.array([len(networks[0][k].bias) for k in (0, 2)] + outputs)
    bends = np.array([isinstance(network[1], nn.Tanh) for network in networks])
    rows = descriptors.reshape(-1, descriptors.shape[-1]).contiguous()
    found = _Attributes.apply(rows, widths, bends, *numbers)
    return torch.split(found.view(*descriptors.shape[:-1], -1), outputs, -1)


class _Attributes(torch.autograd.Function):
    @staticmethod
    def forward(ctx, rows, widths, bends, *numbers):
        from ghgs_lit.heads.cpu.networks_kernel import attributes as compiled
        from ghgs_lit.kernels.layers import packed

        layers, found = packed(numbers), rows.new_empty(len(rows), int(widths[2:].sum()))
        arrays = rows.detach().numpy(), layers, widths, bends, found.numpy()
        pool.run(
            [partial(compiled(), *arrays, part.start, part.stop) for part in even_parts(len(rows), _TASK)],
            _WORK * len(rows),
        )
        ctx.save_for_backward(rows, *numbers)
        ctx.widths, ctx.bends = widths, bends
        return found

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, slopes):
        from ghgs_lit.heads.cpu.networks_kernel import attributes_back
        from ghgs_lit.kernels.layers import Sums, packed

        rows, *numbers = ctx.saved_tensors
        parts = even_parts(len(rows), _LEARNED)
        sums, d_rows = Sums(numbers, len(parts)), torch.empty_like(rows)
        layers = packed(numbers), packed(numbers, transposed=True), sums.places, ctx.widths, ctx.bends
        arrays = [x.detach().numpy() for x in (rows, slopes.contiguous())]
        tasks = [
            partial(attributes_back(), *arrays, *layers, own, d_rows.numpy(), part.start, part.stop)
            for own, part in zip(sums.of_task, parts, strict=True)
        ]
        pool.run(tasks, 4 * _WORK * len(rows))
        return d_rows, None, None, *sums.gradients()
