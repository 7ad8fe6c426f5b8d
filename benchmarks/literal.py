"""The published blocks written out: the yardstick that our own kernels and rearrangements must beat."""

import dataclasses
import math
from types import MethodType

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ghgs_lit.encoder.block import Attention, Block, Rotary, rotate
from ghgs_lit.kernels.linear import Linear
from ghgs_lit.model import GHGS
from ghgs_lit.plan import Plan
from ghgs_lit.recalibration import Recalibration
from ghgs_lit.types import Points, Tokens
from tests.helpers.literal_recalibration import literal_recalibration


def write_out(model: GHGS) -> GHGS:
    """Let ``model`` compute its encoder by ``nn.Linear`` and PyTorch's attention, all tokens at once, and its
    recalibration by gathers, each layer by itself. Its dense heads stay; its weights are not touched.

    Sequences must be of one length (``skip.tokens=all``), and all tokens be recalibrated.
    """
    for module in model.modules():
        for kind, forward in _FORWARDS.items():
            if isinstance(module, kind):
                module.forward = MethodType(forward, module)
    return model


def _attention(self: Attention, x: Tensor, lengths: list[int], rotary: Rotary | None = None) -> Tensor:
    count, width = len(lengths), x.shape[-1]
    qkv = F.linear(x, self.qkv.weight, self.qkv.bias).reshape(count, -1, 3, self.heads, width // self.heads)
    q, k, v = qkv.permute(2, 0, 3, 1, 4)
    q, k = self.q_norm(q), self.k_norm(k)
    if rotary is not None:
        tables = Rotary(*(table.unflatten(0, (count, -1))[:, None] for table in rotary))
        q, k = rotate(q, tables), rotate(k, tables)
    y = F.scaled_dot_product_attention(q, k, v).transpose(1, 2).reshape(len(x), width)
    return F.linear(y, self.proj.weight, self.proj.bias)


def _block(self: Block, x: Tensor, lengths: list[int], rotary: Rotary | None = None) -> Tensor:
    x = x + self.attn(self.norm1(x), lengths, rotary) * self.ls1.gamma
    return x + self.mlp(self.norm2(x)) * self.ls2.gamma


def _recalibration(self: Recalibration, tokens: Tokens, points: Points, plan: Plan) -> Tokens:
    counts = [math.prod(tokens.grid[1:])] * tokens.grid[0]
    parts = list(zip(points.tokens.split(counts), tokens.semantic.split(counts), strict=True))
    layers = [
        torch.cat(
            [
                literal_recalibration(self.block, x, *part, self.k)
                for x, part in zip(layer.split(counts), parts, strict=True)
            ]
        )
        for layer in tokens.latent
    ]
    return dataclasses.replace(tokens, latent=tuple(layers))


_FORWARDS = {Linear: nn.Linear.forward, Attention: _attention, Block: _block, Recalibration: _recalibration}
