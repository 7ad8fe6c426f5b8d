"""Multi-head self-attention of the ViT (plain) and of the aggregator (normalised, rotated q and k)."""

import torch.nn.functional as F
from einops import rearrange
from jaxtyping import Float
from torch import Tensor, nn

from ghgs_lit.encoder.rope import Rotary, rotate
from ghgs_lit.errors import require


class Attention(nn.Module):
    """``qk_norm`` normalises q and k over the channels of a head, before they are rotated."""

    def __init__(self, width: int, heads: int, qk_norm: bool):
        super().__init__()
        require(width % heads == 0, "encoder.heads", f"a divisor of the width {width}", heads)
        self.heads = heads
        self.qkv = nn.Linear(width, 3 * width)
        self.q_norm = nn.LayerNorm(width // heads) if qk_norm else nn.Identity()
        self.k_norm = nn.LayerNorm(width // heads) if qk_norm else nn.Identity()
        self.proj = nn.Linear(width, width)

    def forward(self, x: Float[Tensor, "n t c"], rotary: Rotary | None = None) -> Float[Tensor, "n t c"]:
        q, k, v = rearrange(self.qkv(x), "n t (s a d) -> s n a t d", s=3, a=self.heads)
        q, k = self.q_norm(q), self.k_norm(k)
        if rotary is not None:
            q, k = rotate(q, rotary), rotate(k, rotary)
        y = F.scaled_dot_product_attention(q.to(v.dtype), k.to(v.dtype), v)
        return self.proj(rearrange(y, "n a t d -> n t (a d)"))
