"""Recurrent memory of the refinement rounds: two small MLPs on the observations of each Gaussian.

The first MLP runs for every view; for eight people, its hidden layers would write and read hundreds of
megabytes. Kernels keep them in registers or in the cache."""

from collections.abc import Sequence
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn
from torch.library import register_autograd

from ghgs_lit.geometry.precision import rounds_products
from ghgs_lit.ops.dispatch import LIBRARY, Operator
from ghgs_lit.ops.pool import at_once, even_parts, multiplies

#: Number of Gaussians per part on a CPU: a part fits the cache, which halves the time.
_AT_ONCE = 2048


def update_memory(
    layers: Sequence[nn.Linear],
    each: Float[Tensor, "N V c"],
    known: Float[Tensor, "N k"],
    memory: Float[Tensor, "N h"],
) -> Float[Tensor, "N h"]:
    """Update the memory of each Gaussian.

    Args:
        layers: two layers of the view MLP, two of the update MLP, and the output layer.
        each: observations in V >= 2 views, the Gaussian's own view first.
        known: additional inputs of each Gaussian.
        memory: memory of the previous rounds.

    Returns:
        The new memory [N, h].
    """
    return _remember(each, known, memory, [x for layer in layers for x in (layer.weight, layer.bias)])


def plain(each: Tensor, known: Tensor, memory: Tensor, weights: Sequence[Tensor]) -> Tensor:
    """The operator in plain PyTorch; without a gradient, Gaussians are processed in parts.

    Args:
        each: observations in each view [N, V, c].
        known: additional inputs [N, k].
        memory: memory of the previous rounds [N, h].
        weights: weights and biases of the five layers, alternating.
    """
    count = len(each)
    most = count if torch.is_grad_enabled() else at_once(each.device, _AT_ONCE, count)
    parts = even_parts(count, most)
    return torch.cat([_update(each[part], known[part], memory[part], weights) for part in parts])


def _update(each: Tensor, known: Tensor, memory: Tensor, weights: Sequence[Tensor]) -> Tensor:
    own, others = _two_layers(each, weights[:4]).split((1, each.shape[1] - 1), 1)
    inputs = torch.cat((own[:, 0], others.mean(1), others.amax(1), known, memory), -1)
    return torch.tanh(memory + F.linear(_two_layers(inputs, weights[4:8]), *weights[8:]))


def _two_layers(x: Tensor, weights: Sequence[Tensor]) -> Tensor:
    """Apply two linear layers, given by alternating weights and biases, each followed by a ReLU."""
    x = F.relu_(F.linear(x, *weights[:2]))
    return F.relu_(F.linear(x, *weights[2:]))


def _fits_gpu(*inputs: Any) -> bool:
    """Whether the kernel supports the inputs: TF32 products, no autocast, no gradient."""
    kind = inputs[0].device.type
    is_rounding = rounds_products(kind) and not torch.is_autocast_enabled(kind)
    return is_rounding and not torch.is_grad_enabled()


_remember = Operator(
    "remember(Tensor each, Tensor known, Tensor memory, Tensor[] weights) -> Tensor",
    plain,
    __name__,
    {"cpu": lambda *inputs: multiplies(*inputs[:3]), "cuda": _fits_gpu},
    learned={"cpu": (0, 1, 2, 3)},
)


def _save(ctx: Any, inputs: tuple, output: Tensor) -> None:
    *rows, weights = inputs
    ctx.save_for_backward(*rows, output, *weights)


@torch.autograd.function.once_differentiable
def _back(ctx: Any, slopes: Tensor) -> tuple:
    """Gradients of the previous memory and of the layers; observations need none."""
    from ghgs_lit.ops.round_memory.gradients import gradients  # here: it loads a compiler

    return None, None, *gradients(ctx.saved_tensors[:4], ctx.saved_tensors[4:], slopes)


register_autograd("ghgs_lit::remember", _back, setup_context=_save, lib=LIBRARY)
