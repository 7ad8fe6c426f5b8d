"""Attention and cosines of all tokens of one batch element to their neighbours, distributed over threads."""

from collections.abc import Callable
from functools import partial

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ghgs_lit.kernels import pool
from ghgs_lit.kernels.parts import even_parts

# Floats of a vector; products above which the kernel is worth it; tokens of a task.
_LANES, _LARGE, _TOKENS = 16, 1 << 22, 32
# Features whose largest component is smaller are scaled before they are squared.
_LEAST = 1e-15


def is_supported(x: Tensor, heads: int, k: int) -> bool:
    """Whether the kernels can do the work, and faster than PyTorch.

    Args:
        x: queries or features [n, c].
        heads: number of heads (1 for cosines).
        k: neighbours of each token.
    """
    if torch.is_grad_enabled() or x.device.type != "cpu" or x.dtype != torch.float32:
        return False
    return x.shape[1] % (heads * _LANES) == 0 and x.numel() * k >= _LARGE


def attend(
    q: Float[Tensor, "m c"],
    k: Float[Tensor, "n c"],
    v: Float[Tensor, "n c"],
    heads: int,
    index: Int[Tensor, "m k"],
    valid: Bool[Tensor, "m k"],
    factor: Float[Tensor, "m k"],
    bias: Float[Tensor, "m k"],
) -> Float[Tensor, "m c"]:
    """``softmax(factor q k^T / sqrt(c / heads) + bias) v`` of every head, over the valid neighbours.

    The result has the same bits with any number of threads.

    Args:
        q: queries.
        k, v: keys and values of all tokens.
        heads: number of heads, which divide the channels.
        index: neighbours of each query, as rows of ``k`` and ``v``.
        valid: which of them count.
        factor, bias: what logits are multiplied by, and what is added to them.
    """
    from ghgs_lit.recalibration.cpu.kernel import attend_tokens  # here: it loads a compiler

    out = torch.empty(q.shape)
    tables = (index, valid, factor, bias, out)
    _run(attend_tokens(), *(_rows(x) for x in (q, k, v)), *(x.contiguous().numpy() for x in tables), heads)
    return out


def cosines(features: Float[Tensor, "n c"], index: Int[Tensor, "n k"]) -> Float[Tensor, "n k"]:
    """Cosines of the features of each token and of its neighbours ``index``; 0 where one has length 0."""
    from ghgs_lit.recalibration.cpu.kernel import compare_tokens

    out = torch.empty(index.shape)
    features = features.detach()
    largest = features.abs().amax(-1, keepdim=True)
    if bool(((largest < _LEAST) | (largest > 1 / _LEAST)).any()):  # their squares would vanish or overflow
        features = features / torch.where(largest > 0, largest, 1.0)
    lengths = features.norm(dim=-1)
    inverse_lengths = 1 / torch.where(lengths > 0, lengths, 1.0)
    tables = (inverse_lengths, index.contiguous(), out)
    _run(compare_tokens(), _rows(features), *(x.numpy() for x in tables))
    return out


def _run(compiled: Callable, *arguments) -> None:
    """Call the kernel on parts of the tokens, several at a time."""
    parts = even_parts(len(arguments[0]), _TOKENS)
    tasks = [partial(compiled, *arguments, part.start, part.stop) for part in parts]
    pool.run(tasks, work=pool.GRAIN * len(parts))


def _rows(x: Tensor) -> np.ndarray:
    """A matrix whose rows are contiguous."""
    return (x if x.stride(1) == 1 else x.contiguous()).detach().numpy()
