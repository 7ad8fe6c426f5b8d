"""Attention within sequences of equal length; CPUs with AVX2 or AVX-512 use a fused kernel, which does
not store the matrix of all scores."""

import torch
import torch.nn.functional as F
from einops import rearrange
from torch import Tensor

from ghgs_lit.ops import pool
from ghgs_lit.ops.dispatch import Operator

#: The kernel supports head widths that are multiples of this.
WIDTH = 32
#: Multiplications from which the kernel is faster on one thread, such as 360 tokens in two heads of 32
#: channels.
_SMALL = 1 << 23
#: The same on several threads, where PyTorch's operator divides small products better; 1450 tokens.
_LARGE = 1 << 27
# Processor features that the kernel needs.
_FEATURES = {"avx2", "fma"}


def _attend(q: Tensor, k: Tensor, v: Tensor, keys: Tensor | None) -> Tensor:
    """``softmax(q k^T / sqrt(d)) v`` of every head, heads concatenated.

    Args:
        q: queries [n, a, t, d] of n sequences and a heads.
        k: keys [n, a, s, d].
        v: values [n, a, s, d].
        keys: mask of valid keys [n, 1, 1, s]; None: all.

    Returns:
        [n, t, a d] in the dtype of ``v``.
    """
    mask = {} if keys is None else {"attn_mask": keys}  # flash kernels do not support masks
    y = F.scaled_dot_product_attention(q.to(v.dtype), k.to(v.dtype), v, **mask)
    return rearrange(y, "n a t d -> n t (a d)")


def _fits_cpu(q: Tensor, k: Tensor, v: Tensor, keys: Tensor | None) -> bool:
    """Whether the kernel supports the inputs (no mask, no gradient) and is faster (large products)."""
    if keys is not None or torch.is_grad_enabled():
        return False
    n, a, t, d = q.shape
    least = _SMALL if torch.get_num_threads() == 1 else _LARGE
    return d % WIDTH == 0 and n * a * t * v.shape[2] * d >= least and pool.features() >= _FEATURES


attend = Operator(
    "attend(Tensor q, Tensor k, Tensor v, Tensor? keys) -> Tensor",
    _attend,
    __name__,
    {"cpu": _fits_cpu},
    dtypes=(torch.float32, torch.bfloat16),
)
