"""The memory of the rounds on a GPU: its two small networks as one operator, without a gradient.

Each Gaussian is seen by several views, and a network runs for each of them; between its layers hundreds of
megabytes would be written and read again for eight people. One kernel keeps them in registers."""

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from ghgs_lit.kernels import gpu
from ghgs_lit.runtime.precision import rounds_products


def fits(*rows: Tensor) -> bool:
    """Whether the kernel computes with these: on a GPU, without a gradient, where products round to TF32.

    Args:
        rows: observations, what is known, the memory, and a weight.
    """
    return (
        not torch.is_grad_enabled()
        and gpu.is_supported(*rows)
        and not torch.is_autocast_enabled(rows[0].device.type)
        and rounds_products(rows[0].device.type)
    )


def remembered(
    layers: Sequence[nn.Linear],
    each: Float[Tensor, "N V c"],
    known: Float[Tensor, "N k"],
    memory: Float[Tensor, "N h"],
) -> Float[Tensor, "N h"]:
    """The new memory of each Gaussian, as of :meth:`ghgs_lit.rounds.rounds.Rounds._remembered`.

    Args:
        layers: two of the views, two of the update, and the last one.
        each: observations of each view, the own one first; two or more.
        known: what is known of each Gaussian beside them.
        memory: of the rounds before.
    """
    weights = [tensor for layer in layers for tensor in (layer.weight, layer.bias)]
    return _REMEMBER(each, known, memory, weights)


def _remembered(each: Tensor, known: Tensor, memory: Tensor, weights: Sequence[Tensor]) -> Tensor:
    """:func:`remembered` in plain PyTorch, with the weights and biases of its layers in turn."""
    seen = F.relu(F.linear(F.relu(F.linear(each, *weights[:2])), *weights[2:4]))
    inputs = torch.cat((seen[:, 0], seen[:, 1:].mean(1), seen[:, 1:].amax(1), known, memory), -1)
    updated = F.relu(F.linear(F.relu(F.linear(inputs, *weights[4:6])), *weights[6:8]))
    return torch.tanh(memory + F.linear(updated, *weights[8:]))


_REMEMBER = gpu.operator(
    "remember(Tensor each, Tensor known, Tensor memory, Tensor[] weights) -> Tensor",
    _remembered,
    "ghgs_lit.rounds.cuda",
)
