"""Pre-norm transformer block with LayerScale, used by the ViT and the aggregator."""

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from ghgs_lit.encoder.attention import Attention, Rotary
from ghgs_lit.kernels.linear import Linear
from ghgs_lit.kernels.pool import even_parts

#: Register tokens of each view, of the ViT and of the aggregator.
REGISTERS = 4

#: Hidden values of the MLP that are held at once without a gradient (bounds memory).
_HIDDEN = 1 << 23


def draw_normal_(values: Tensor, std: float) -> Tensor:
    """Draw ``values`` in place. The meta device has none, and PyTorch would import its compiler there."""
    return values if values.is_meta else values.normal_(std=std)


class LayerScale(nn.Module):
    """Adds a branch to the residual stream, scaled by a learned ``gamma`` for each channel."""

    def __init__(self, width: int, init: float):
        super().__init__()
        self.gamma = nn.Parameter(torch.full((width,), float(init)))

    def forward(self, x: Float[Tensor, "*n c"], branch: Float[Tensor, "*n c"]) -> Float[Tensor, "*n c"]:
        return torch.addcmul(x, branch, self.gamma)


class Mlp(nn.Module):
    """Two linear layers with the exact GELU between them; the hidden width is ``4 * width``."""

    def __init__(self, width: int):
        super().__init__()
        self.fc1 = Linear(width, 4 * width)
        self.fc2 = Linear(4 * width, width)

    def forward(self, x: Float[Tensor, "*n c"]) -> Float[Tensor, "*n c"]:
        return self.fc2(F.gelu(self.fc1(x)))


class Block(nn.Module):
    """``x + gamma1 Attention(LN(x))``, then ``x + gamma2 MLP(LN(x))``, on packed sequences."""

    def __init__(self, width: int, heads: int, qk_norm: bool, norm_eps: float, layer_scale: float):
        super().__init__()
        self.norm1 = nn.LayerNorm(width, eps=norm_eps)
        self.attn = Attention(width, heads, qk_norm)
        self.ls1 = LayerScale(width, layer_scale)
        self.norm2 = nn.LayerNorm(width, eps=norm_eps)
        self.mlp = Mlp(width)
        self.ls2 = LayerScale(width, layer_scale)

    def forward(
        self, x: Float[Tensor, "t c"], lengths: Sequence[int], rotary: Rotary | None = None
    ) -> Float[Tensor, "t c"]:
        x = self.ls1(x, self.attn(self.norm1(x), lengths, rotary))
        if torch.is_grad_enabled():
            return self.ls2(x, self.mlp(self.norm2(x)))
        # x is the fresh result of ls1, so it can be changed in place, a part of the tokens at a time.
        for rows in even_parts(len(x), _HIDDEN // (4 * x.shape[-1])):
            x[rows].addcmul_(self.mlp(self.norm2(x[rows])), self.ls2.gamma)
        return x


def run_block(
    block: Block,
    x: Float[Tensor, "t c"],
    lengths: Sequence[int],
    checkpointing: bool,
    rotary: Rotary | None = None,
) -> Float[Tensor, "t c"]:
    """``block(x)``; no gradient is recorded where neither ``x`` nor the block needs one. ``x``: tokens of all
    sequences, one after another. ``lengths``: tokens of each sequence; attention stays inside it.
    ``checkpointing``: recompute the block's activations in the backward pass instead of keeping them.
    ``rotary``: tables that rotate queries and keys; None for no rotation."""
    needs_grad = x.requires_grad or any(p.requires_grad for p in block.parameters())
    with torch.set_grad_enabled(needs_grad and torch.is_grad_enabled()):
        if checkpointing and torch.is_grad_enabled():
            return checkpoint(block, x, lengths, rotary, use_reentrant=False)
        return block(x, lengths, rotary)
