"""Multi-head self-attention of the ViT (plain) and of the aggregator (normalised, rotated q and k)."""

import torch
import torch.nn.functional as F
from einops import rearrange
from jaxtyping import Float
from torch import Tensor, nn

from ghgs_lit.encoder.rope import Rotary, rotate
from ghgs_lit.errors import require
from ghgs_lit.geometry.projection import wide
from ghgs_lit.linear import Linear, even_parts, prefers_convolution, product

#: Scores that :func:`attend` holds at once: 16 MB, which stay in a CPU's cache.
_SCORES = 1 << 22


class Attention(nn.Module):
    """``qk_norm`` normalises q and k over the channels of a head, before they are rotated."""

    def __init__(self, width: int, heads: int, qk_norm: bool):
        super().__init__()
        require(width % heads == 0, "encoder.heads", f"a divisor of the width {width}", heads)
        self.heads = heads
        self.qkv = Linear(width, 3 * width)
        self.q_norm = nn.LayerNorm(width // heads) if qk_norm else nn.Identity()
        self.k_norm = nn.LayerNorm(width // heads) if qk_norm else nn.Identity()
        self.proj = Linear(width, width)

    def forward(self, x: Float[Tensor, "n t c"], rotary: Rotary | None = None) -> Float[Tensor, "n t c"]:
        q, k, v = rearrange(self.qkv(x), "n t (s a d) -> s n a t d", s=3, a=self.heads)
        if torch.is_grad_enabled() or x.dtype == torch.float64 or not prefers_convolution(x.device):
            q, k = self._place(q, k, rotary)
            y = F.scaled_dot_product_attention(q.to(v.dtype), k.to(v.dtype), v)
            return self.proj(rearrange(y, "n a t d -> n t (a d)"))
        y = torch.empty_like(v.transpose(1, 2), memory_format=torch.contiguous_format)
        # Head by head, so that all that happens to a head happens in the cache.
        for i in range(len(x)):
            for a in range(self.heads):
                attend(*self._place(q[i, a], k[i, a], rotary), v[i, a], out=y[i, :, a])
        return self.proj(y.flatten(2))

    def _place(self, q: Tensor, k: Tensor, rotary: Rotary | None) -> tuple[Tensor, Tensor]:
        """Normalise queries and keys and turn them by their positions."""
        q, k = self.q_norm(q), self.k_norm(k)
        return (q, k) if rotary is None else (rotate(q, rotary), rotate(k, rotary))


def attend(
    q: Float[Tensor, "t d"], k: Float[Tensor, "s d"], v: Float[Tensor, "s d"], out: Float[Tensor, "t d"]
) -> None:
    """``softmax(q k^T / sqrt(d)) v`` of one head into ``out``: on a CPU, in float32, without a gradient.

    PyTorch's own runs at less than half the rate of this CPU's products, in bfloat16 at a sixth.
    """
    with torch.autocast("cpu", enabled=False):
        q, k, v = wide(q) * q.shape[-1] ** -0.5, wide(k).contiguous(), wide(v).T.contiguous()
        for rows in even_parts(len(q), _SCORES // len(k)):
            scores = product(q[rows], k)
            out[rows] = product(torch.softmax(scores, -1, out=scores), v)
