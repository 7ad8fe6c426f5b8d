"""Attention and cosines of all tokens of one batch element to their neighbours, shared out to threads."""

from collections.abc import Callable
from functools import partial

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ghgs_lit.kernels import pool
from ghgs_lit.kernels.parts import even_parts

# Floats of a vector; products from which the kernel pays; tokens of a task.
_LANES, _LARGE, _TOKENS = 16, 1 << 22, 32


def is_supported(x: Tensor, heads: int, k: int) -> bool:
    """Whether the kernels can and should take queries or features ``x`` [n, c] with ``k`` neighbours each."""
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
    term: Float[Tensor, "m k"],
) -> Float[Tensor, "m c"]:
    """``softmax(factor q k^T / sqrt(c / heads) + term) v`` over the valid neighbours ``index``, by heads.

    The same bits with any number of threads.
    """
    from ghgs_lit.recalibration.cpu.kernel import attend_tokens  # late: it loads a compiler

    out = torch.empty(q.shape)
    tables = (index, valid, factor, term, out)
    _run(attend_tokens(), *(_rows(x) for x in (q, k, v)), *(x.contiguous().numpy() for x in tables), heads)
    return out


def cosines(features: Float[Tensor, "n c"], index: Int[Tensor, "n k"]) -> Float[Tensor, "n k"]:
    """Cosines of the features of tokens and of those that ``index`` names; 0 where one has no length."""
    from ghgs_lit.recalibration.cpu.kernel import compare_tokens

    out = torch.empty(index.shape)
    shares = 1 / features.detach().norm(dim=-1).clamp(min=1e-12)
    _run(compare_tokens(), _rows(features), *(x.numpy() for x in (shares, index.contiguous(), out)))
    return out


def _run(compiled: Callable, *arguments) -> None:
    """Call the kernel for some tokens at a time."""
    parts = even_parts(len(arguments[0]), _TOKENS)
    tasks = [partial(compiled, *arguments, part.start, part.stop) for part in parts]
    pool.run(tasks, work=pool.GRAIN * len(parts))


def _rows(x: Tensor) -> np.ndarray:
    return (x if x.stride(1) == 1 else x.contiguous()).detach().numpy()
