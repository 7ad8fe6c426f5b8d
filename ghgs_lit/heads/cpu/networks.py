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


def attributes(
    networks: list[nn.Sequential], descriptors: Float[Tensor, "*n c"]
) -> tuple[Float[Tensor, "*n _"], ...]:
    """What each of the networks makes of the descriptors; see :func:`ghgs_lit.kernels.pool.multiplies`.
    ``networks``: of three layers, of equal widths but for the last, with ``nn.Tanh`` or ``nn.ReLU`` between.
    ``descriptors``: of pixels."""
    from ghgs_lit.heads.cpu.networks_kernel import attributes as compiled  # here: it loads a compiler
    from ghgs_lit.kernels.layers import packed, parameters

    layers = packed(parameters([layer for network in networks for layer in network]))
    outputs = [len(network[4].bias) for network in networks]
    rows = descriptors.reshape(-1, descriptors.shape[-1]).contiguous()
    found = rows.new_empty(len(rows), sum(outputs))
    widths = np.array([len(networks[0][k].bias) for k in (0, 2)] + outputs)
    bends = np.array([isinstance(network[1], nn.Tanh) for network in networks])
    pool.run(
        [
            partial(compiled(), rows.numpy(), layers, widths, bends, found.numpy(), part.start, part.stop)
            for part in even_parts(len(rows), _TASK)
        ],
        _WORK * len(rows),
    )
    return torch.split(found.view(*descriptors.shape[:-1], -1), outputs, -1)
