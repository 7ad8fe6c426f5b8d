"""Attention for CPUs with AVX2 or AVX-512, in one pass without the matrix of all
scores in memory."""

import itertools
from functools import partial
from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor

from ghgs_lit.kernels import pool

#: Head widths must be multiples of this.
WIDTH = 32
#: Keys whose scores are in memory at once.
KEYS = 256
#: Queries that are compared with those keys before the next keys are read.
QUERIES = 96


#: Multiplications from which the kernel is faster on one thread:
#: 360 tokens in two heads of 32 channels.
_SMALL = 1 << 23
#: The same on several threads, where PyTorch's operator divides small products better: 1450 tokens.
_LARGE = 1 << 27
# Processor features that the kernel needs.
_FEATURES = {"avx2", "fma"}


def is_supported(q: Tensor, v: Tensor) -> bool:
    """Whether :func:`attend` is faster than PyTorch.

    Args:
        q: queries [n, a, t, d].
        v: values [n, a, s, d].

    Returns:
        False while gradients are recorded, for other devices and dtypes than float32 and bfloat16
        on a CPU with AVX2, for small products, and for head widths that are no multiples of
        :data:`WIDTH`.
    """
    if torch.is_grad_enabled() or v.device.type != "cpu" or v.dtype not in (torch.float32, torch.bfloat16):
        return False
    n, a, t, d = q.shape
    least = _SMALL if torch.get_num_threads() == 1 else _LARGE
    return d % WIDTH == 0 and n * a * t * v.shape[2] * d >= least and pool.features() >= _FEATURES


def attend(
    q: Float[Tensor, "n a t d"], k: Float[Tensor, "n a s d"], v: Float[Tensor, "n a s d"]
) -> Float[Tensor, "n t a d"]:
    """``softmax(q k^T / sqrt(d)) v`` of every head, computed in float32,
    where :func:`is_supported`.

    Args:
        q: queries [n, a, t, d] of n sequences and a heads.
        k: keys [n, a, s, d].
        v: values [n, a, s, d].

    Returns:
        [n, t, a, d] in the dtype of ``v``, with the same bits with any number of threads.
    """
    from ghgs_lit.method.encoder.cpu.kernel import attend_head

    out = torch.empty(q.transpose(1, 2).shape)
    arrays = [_rows(x.float()).numpy() for x in (q, k, v, out.transpose(1, 2))]
    n, a, t, d = q.shape
    heads = list(itertools.product(range(n), range(a)))
    # Every task packs keys and values again, so a head is split only if there are few heads.
    parts = max(1, min(-(-2 * torch.get_num_threads() // len(heads)), t // QUERIES))
    edges = [t * p // (parts * QUERIES) * QUERIES for p in range(parts)] + [t]
    compiled = attend_head()
    tasks = []
    for head in heads:
        matrices = [x[head] for x in arrays]
        tasks += [partial(compiled, *matrices, first, last) for first, last in pairwise(edges)]
    pool.run(tasks, work=n * a * t * d)
    return out.to(v.dtype)


def _rows(x: Tensor) -> Tensor:
    return x if x.stride(-1) == 1 else x.contiguous()
