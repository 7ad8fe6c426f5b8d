"""Attention inside sequences of one length; on CPUs with AVX2 or AVX-512 in one pass without the matrix
of all scores in memory."""

import torch
import torch.nn.functional as F
from einops import rearrange
from torch import Tensor

from ghgs_lit.ops import pool
from ghgs_lit.ops.dispatch import Operator

#: Head widths of the kernel are multiples of this.
WIDTH = 32
#: Multiplications from which the kernel is faster on one thread:
#: 360 tokens in two heads of 32 channels.
_SMALL = 1 << 23
#: The same on several threads, where PyTorch's operator divides small products better: 1450 tokens.
_LARGE = 1 << 27
# Processor features that the kernel needs.
_FEATURES = {"avx2", "fma"}


def _attended(q: Tensor, k: Tensor, v: Tensor, keys: Tensor | None) -> Tensor:
    """``softmax(q k^T / sqrt(d)) v`` of every head, heads concatenated.

    Args:
        q: queries [n, a, t, d] of n sequences and a heads.
        k: keys [n, a, s, d].
        v: values [n, a, s, d].
        keys: which keys take part [n, 1, 1, s]; None: all.

    Returns:
        [n, t, a d] in the dtype of ``v``.
    """
    mask = {} if keys is None else {"attn_mask": keys}  # flash kernels take none
    y = F.scaled_dot_product_attention(q.to(v.dtype), k.to(v.dtype), v, **mask)
    return rearrange(y, "n a t d -> n t (a d)")


def _fits_cpu(q: Tensor, k: Tensor, v: Tensor, keys: Tensor | None) -> bool:
    """Whether the kernel is faster: without a gradient, and for products that are not small."""
    if keys is not None or torch.is_grad_enabled():
        return False
    n, a, t, d = q.shape
    least = _SMALL if torch.get_num_threads() == 1 else _LARGE
    return d % WIDTH == 0 and n * a * t * v.shape[2] * d >= least and pool.features() >= _FEATURES


attend = Operator(
    "attend(Tensor q, Tensor k, Tensor v, Tensor? keys) -> Tensor",
    _attended,
    __name__,
    {"cpu": _fits_cpu},
    dtypes=(torch.float32, torch.bfloat16),
)
