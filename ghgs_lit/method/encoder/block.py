"""Pre-norm transformer block with LayerScale, for the ViT and, with normalised and rotated q and
k, for the aggregator.

The rotary position embedding (RoPE) is two-dimensional: half of a head's channels rotate with the
row, half with the column. Angles are float32 or wider for tokens of any precision: rounding an angle
to bfloat16 would change its cosine by up to 6e-2, rounding the cosine itself only by 2e-3."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as F
from einops import rearrange
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from ghgs_lit.geometry.projection import at_least_float32
from ghgs_lit.ops.attention import attend
from ghgs_lit.ops.linear import Linear
from ghgs_lit.ops.pool import at_once, even_parts

BASE = 100.0


class Rotary(NamedTuple):
    """Cosine and signed sine for every token and channel of a head."""

    cosine: Float[Tensor, "t d"]
    sine: Float[Tensor, "t d"]


def rotary_tables(positions: Int[Tensor, "t 2"], head_width: int, like: Tensor) -> Rotary:
    """Rotary tables [t, d] of all tokens.

    Args:
        positions: row and column of each token [t, 2].
        head_width: channels d of a head, divisible by 4.
        like: the tokens; tables are float64 for tokens in float64, else float32.
    """
    exponents = torch.arange(0, head_width, 4, device=positions.device, dtype=torch.float32) / head_width
    angles = positions.float()[..., None] * (1.0 / BASE**exponents)
    angles = angles.to(at_least_float32(like).dtype)
    cosine = angles.cos()
    sine = angles.sin()
    return Rotary(
        torch.stack((cosine, cosine), dim=-2).flatten(-3), torch.stack((-sine, sine), dim=-2).flatten(-3)
    )


def rotate(x: Float[Tensor, "*batch t d"], rotary: Rotary) -> Float[Tensor, "*batch t d"]:
    """Rotate channels ``m`` and ``m + d/4`` of each half of a head, in the wider dtype of both arguments.

    Args:
        x: queries or keys [..., t, d].
        rotary: tables of these t tokens.
    """
    quarters = x.unflatten(-1, (2, 2, x.shape[-1] // 4))
    return torch.addcmul(x * rotary.cosine, quarters.flip(-2).flatten(-3), rotary.sine)


#: Largest number of query or key values rotated at once without a gradient, to save memory.
_ROTATED = 1 << 18  # on a CPU
_GPU_ROTATED = 1 << 25


class Attention(nn.Module):
    """Multi-head self-attention inside each of several packed sequences.

    Args:
        width: channels of the tokens.
        heads: number of heads, which divides ``width``.
        qk_norm: apply layer norm to q and k over the channels of each head, before their rotation.
    """

    def __init__(self, width: int, heads: int, qk_norm: bool):
        super().__init__()
        self.heads = heads
        self.qkv = Linear(width, 3 * width)
        self.q_norm = nn.LayerNorm(width // heads) if qk_norm else nn.Identity()
        self.k_norm = nn.LayerNorm(width // heads) if qk_norm else nn.Identity()
        self.proj = Linear(width, width)

    def forward(
        self,
        x: Float[Tensor, "t c"],
        lengths: Sequence[int],
        rotary: Rotary | None = None,
        real: Bool[Tensor, " t"] | None = None,
    ) -> Float[Tensor, "t c"]:
        """Attend within each sequence.

        Args:
            x: tokens of all sequences, concatenated.
            lengths: number of tokens of each sequence.
            rotary: tables of all tokens; None: no rotation.
            real: tokens that can be attended to, if all sequences have the same length; None: all.
        """
        q, k, v = rearrange(self.qkv(x), "t (s a d) -> s a t d", s=3, a=self.heads)
        q = self._norm_and_rotate(q, self.q_norm, rotary)
        k = self._norm_and_rotate(k, self.k_norm, rotary)
        if len(set(lengths)) == 1:
            each = (rearrange(values, "a (n t) d -> n a t d", n=len(lengths)) for values in (q, k, v))
            keys = None if real is None else real.view(len(lengths), 1, 1, -1)
            return self.proj(attend(*each, keys).flatten(0, 1))
        # One by one: with a block mask, products between different sequences would be computed, too.
        parts = zip(*(values[None].split(lengths, dim=2) for values in (q, k, v)), strict=True)
        return self.proj(torch.cat([attend(*part, None)[0] for part in parts]))

    def _norm_and_rotate(self, x: Float[Tensor, "a t d"], norm: nn.Module, rotary: Rotary | None) -> Tensor:
        if rotary is None:
            return norm(x)
        most = (
            len(x) if torch.is_grad_enabled() else at_once(x.device, _ROTATED, _GPU_ROTATED) // x[0].numel()
        )
        if most >= len(x):
            return rotate(norm(x), rotary)
        for heads in even_parts(len(x), most):
            x[heads] = rotate(norm(x[heads]), rotary)
        return x


#: Register tokens of each view in the ViT and in the aggregator.
REGISTERS = 4

#: Largest number of hidden values of the MLP in memory at once without a gradient.
_HIDDEN = 1 << 23  # on a CPU
_GPU_HIDDEN = 1 << 28


def draw_normal_(values: Tensor, std: float) -> Tensor:
    """Fill ``values`` with samples of a normal distribution of mean 0, except on the meta device, where
    PyTorch would import its compiler; returns ``values``."""
    return values if values.is_meta else values.normal_(std=std)


class LayerScale(nn.Module):
    """Adds a branch to the residual stream, scaled by a learned ``gamma`` per channel."""

    def __init__(self, width: int, init: float):
        super().__init__()
        self.gamma = nn.Parameter(torch.full((width,), float(init)))

    def forward(self, x: Float[Tensor, "*n c"], branch: Float[Tensor, "*n c"]) -> Float[Tensor, "*n c"]:
        return torch.addcmul(x, branch, self.gamma)


class Mlp(nn.Module):
    """Two linear layers with an exact GELU in between; the hidden width is ``4 * width``."""

    def __init__(self, width: int):
        super().__init__()
        self.fc1 = Linear(width, 4 * width)
        self.fc2 = Linear(4 * width, width)

    def forward(self, x: Float[Tensor, "*n c"]) -> Float[Tensor, "*n c"]:
        return self.fc2(F.gelu(self.fc1(x)))


class Block(nn.Module):
    """``x + gamma1 Attention(LN(x))``, then ``x + gamma2 MLP(LN(x))``, on packed sequences.

    Args:
        width: channels of the tokens.
        heads: attention heads, which divide ``width``.
        qk_norm: as for :class:`Attention`.
        norm_eps: epsilon of the layer norms.
        layer_scale: initial value of both gammas.
    """

    def __init__(self, width: int, heads: int, qk_norm: bool, norm_eps: float, layer_scale: float):
        super().__init__()
        self.norm1 = nn.LayerNorm(width, eps=norm_eps)
        self.attn = Attention(width, heads, qk_norm)
        self.ls1 = LayerScale(width, layer_scale)
        self.norm2 = nn.LayerNorm(width, eps=norm_eps)
        self.mlp = Mlp(width)
        self.ls2 = LayerScale(width, layer_scale)

    def forward(
        self,
        x: Float[Tensor, "t c"],
        lengths: Sequence[int],
        rotary: Rotary | None = None,
        real: Bool[Tensor, " t"] | None = None,
    ) -> Float[Tensor, "t c"]:
        """Apply the block; arguments as for :meth:`Attention.forward`."""
        x = self.ls1(x, self.attn(self.norm1(x), lengths, rotary, real))
        if torch.is_grad_enabled():
            return self.ls2(x, self.mlp(self.norm2(x)))
        # x is the fresh result of ls1, so parts of it can be updated in place.
        for rows in even_parts(len(x), at_once(x.device, _HIDDEN, _GPU_HIDDEN) // (4 * x.shape[-1])):
            x[rows].addcmul_(self.mlp(self.norm2(x[rows])), self.ls2.gamma)
        return x


def run_block(
    block: Block,
    x: Float[Tensor, "t c"],
    lengths: Sequence[int],
    checkpointing: bool,
    rotary: Rotary | None = None,
    real: Bool[Tensor, " t"] | None = None,
) -> Float[Tensor, "t c"]:
    """Run a block, without autograd if neither ``x`` nor the block needs a gradient.

    Args:
        block: the block to run.
        x, lengths, rotary, real: as for :meth:`Attention.forward`.
        checkpointing: recompute activations in the backward pass.
    """
    needs_grad = x.requires_grad or any(p.requires_grad for p in block.parameters())
    with torch.set_grad_enabled(needs_grad and torch.is_grad_enabled()):
        if checkpointing and torch.is_grad_enabled():
            return checkpoint(block, x, lengths, rotary, real, use_reentrant=False)
        return block(x, lengths, rotary, real)
