"""Multi-head self-attention of the ViT (plain) and of the aggregator (normalised, rotated q and k)."""

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from einops import rearrange
from jaxtyping import Float
from torch import Tensor, nn

from ghgs_lit.encoder import cpu
from ghgs_lit.encoder.rope import Rotary, rotate
from ghgs_lit.kernels.linear import Linear
from ghgs_lit.kernels.parts import at_once, even_parts

#: Values of queries or keys that are rotated at once without a gradient (bounds memory), and on a GPU.
_ROTATED, _GPU_ROTATED = 1 << 18, 1 << 25


class Attention(nn.Module):
    """Multi-head self-attention inside each of several packed sequences. ``qk_norm``: normalise q and k over
    the channels of each head, before they are rotated."""

    def __init__(self, width: int, heads: int, qk_norm: bool):
        super().__init__()
        self.heads = heads
        self.qkv = Linear(width, 3 * width)
        self.q_norm = nn.LayerNorm(width // heads) if qk_norm else nn.Identity()
        self.k_norm = nn.LayerNorm(width // heads) if qk_norm else nn.Identity()
        self.proj = Linear(width, width)

    def forward(
        self, x: Float[Tensor, "t c"], lengths: Sequence[int], rotary: Rotary | None = None
    ) -> Float[Tensor, "t c"]:
        q, k, v = rearrange(self.qkv(x), "t (s a d) -> s a t d", s=3, a=self.heads)
        q, k = self._norm_and_rotate(q, self.q_norm, rotary), self._norm_and_rotate(k, self.k_norm, rotary)
        if len(set(lengths)) == 1:
            each = (rearrange(values, "a (n t) d -> n a t d", n=len(lengths)) for values in (q, k, v))
            return self.proj(_attend(*each).flatten(0, 1))
        # One by one: a mask of blocks would compute every product of tokens of different sequences, too.
        parts = zip(*(values[None].split(lengths, dim=2) for values in (q, k, v)), strict=True)
        return self.proj(torch.cat([_attend(*part)[0] for part in parts]))

    def _norm_and_rotate(self, x: Float[Tensor, "a t d"], norm: nn.Module, rotary: Rotary | None) -> Tensor:
        """Normalise queries or keys and rotate them by their positions; in place without a gradient."""
        if rotary is None:
            return norm(x)
        if torch.is_grad_enabled():
            return rotate(norm(x), rotary)
        most = at_once(x.device, _ROTATED, _GPU_ROTATED)
        for heads in even_parts(len(x), most // x[0].numel()):
            x[heads] = rotate(norm(x[heads]), rotary)
        return x


def _attend(
    q: Float[Tensor, "n a t d"], k: Float[Tensor, "n a t d"], v: Float[Tensor, "n a t d"]
) -> Float[Tensor, "n t c"]:
    """``softmax(q k^T / sqrt(d)) v`` of every head, with the heads side by side."""
    if cpu.is_supported(q, v):
        return cpu.attend(q, k, v).flatten(2)
    y = F.scaled_dot_product_attention(q.to(v.dtype), k.to(v.dtype), v)
    return rearrange(y, "n a t d -> n t (a d)")
