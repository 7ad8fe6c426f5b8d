"""The memory of the rounds on a GPU: its two small networks as one operator, without a gradient.

Each Gaussian is seen by several views, and a network runs for each of them; between its layers
hundreds of megabytes would be written and read again for eight people. One kernel keeps them
in registers."""

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from ghgs_lit.kernels import gpu
from ghgs_lit.runtime.precision import rounds_products


def fits(*rows: Tensor) -> bool:
    """Whether the kernel computes with these: on a GPU, without a gradient,
    where products round to TF32.

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
    """The new memory of each Gaussian, from what is seen and known;
    for inputs that :func:`fits` accepts.

    Args:
        layers: two of the views, two of the update, and the last one.
        each: observations of each view, the own one first; two or more.
        known: what is known of each Gaussian beside them.
        memory: of the rounds before.
    """
    return _REMEMBER(each, known, memory, _weights_of(layers))


def remembered_plainly(layers: Sequence[nn.Linear], each: Tensor, known: Tensor, memory: Tensor) -> Tensor:
    """:func:`remembered` in plain PyTorch, with a gradient if one is wanted.

    Args:
        layers: as of :func:`remembered`, as are the next ones.
        each: observations.
        known: beside them.
        memory: of the rounds before.
    """
    return _remembered(each, known, memory, _weights_of(layers))


def _weights_of(layers: Sequence[nn.Linear]) -> list[Tensor]:
    """Weights and biases in turn."""
    return [tensor for layer in layers for tensor in (layer.weight, layer.bias)]


def _remembered(each: Tensor, known: Tensor, memory: Tensor, weights: Sequence[Tensor]) -> Tensor:
    """The operator in plain PyTorch.

    Args:
        each: observations of each view [N, V, c].
        known: beside them [N, k].
        memory: of the rounds before [N, h].
        weights: weights and biases of the five layers, in turn.
    """
    own, others = _two_layers(each, weights[:4]).split((1, each.shape[1] - 1), 1)
    inputs = torch.cat((own[:, 0], others.mean(1), others.amax(1), known, memory), -1)
    return torch.tanh(memory + F.linear(_two_layers(inputs, weights[4:8]), *weights[8:]))


def _two_layers(x: Tensor, weights: Sequence[Tensor]) -> Tensor:
    """Two layers with their weights and biases in turn, each with a rectifier in place."""
    x = F.relu_(F.linear(x, *weights[:2]))
    return F.relu_(F.linear(x, *weights[2:]))


_REMEMBER = gpu.operator(
    "remember(Tensor each, Tensor known, Tensor memory, Tensor[] weights) -> Tensor",
    _remembered,
    "ghgs_lit.method.rounds.cuda",
)
