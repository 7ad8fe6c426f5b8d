"""A depth head of two layers: one depth for each patch."""

import torch
import torch.nn.functional as F
from torch import nn

from ghgs_lit.config import register
from ghgs_lit.config.options import Options, Width
from ghgs_lit.method.heads.depth import bounded_depth, finite_maps


@register("depth_head", "linear")
class LinearOptions(Options):
    """One depth for each patch, from its token alone."""

    group = "depth_head"  # in messages
    width: Width = 64
    """Channels of the hidden layer."""

    def build(self, dim_latent: int) -> nn.Module:
        return LinearHead(dim_latent, self.width)


class LinearHead(nn.Module):
    is_bounded = True  # depths lie between near and far of each pixel

    def __init__(self, dim_latent, width):
        super().__init__()
        self.layers = nn.Sequential(nn.Linear(dim_latent, width), nn.GELU(), nn.Linear(width, 1))

    def forward(self, tokens, batch, bounds, plan):
        maps = tokens.maps(3).movedim(1, -1)  # last layer [B * V, h, w, C]; 0 where a patch has no token
        values = self.layers(maps).movedim(-1, 1).float()
        values = F.interpolate(values, batch.masks.shape[2:], mode="bilinear").view(batch.masks.shape)
        depth = bounded_depth(values, bounds.near, bounds.far, "bounded_inverse")
        return finite_maps(depth, batch, torch.ones_like(depth), bounds)  # 1: the confidence
