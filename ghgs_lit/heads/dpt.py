"""Dense prediction head: four layers of tokens fused from coarse to fine into one map per image."""

import dataclasses
from collections.abc import Sequence

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from ghgs_lit.errors import require
from ghgs_lit.heads.guide import GuidePyramid
from ghgs_lit.heads.position import add_positions_
from ghgs_lit.kernels.linear import linear
from ghgs_lit.kernels.parts import even_parts
from ghgs_lit.types import Tokens

LEVELS = 4
#: Values of the largest map that are held at once where no gradient is kept (128 MB in float32).
_LARGEST = 1 << 25
NORM_EPS = 1e-5


def _conv3(inputs: int, outputs: int, bias: bool = True) -> nn.Conv2d:
    return nn.Conv2d(inputs, outputs, 3, padding=1, bias=bias)


def _pointwise(conv: nn.Conv2d, x: Float[Tensor, "n c h w"]) -> Float[Tensor, "n o h w"]:
    """A 1x1 convolution as a linear layer of pixels: no copy, since channels are innermost here."""
    return linear(x.permute(0, 2, 3, 1), conv.weight.flatten(1), conv.bias).permute(0, 3, 1, 2)


def _resize(x: Float[Tensor, "n c h w"], size: Sequence[int]) -> Float[Tensor, "n c h2 w2"]:
    if tuple(x.shape[-2:]) == tuple(size):
        return x
    return F.interpolate(x, size, mode="bilinear", align_corners=True)


class ResidualUnit(nn.Module):
    """``r + conv2(relu(conv1(r)))`` with ``r = relu(x)``: published weights expect a rectified skip."""

    def __init__(self, features: int):
        super().__init__()
        self.conv1 = _conv3(features, features)
        self.conv2 = _conv3(features, features)

    def forward(self, x: Float[Tensor, "n c h w"]) -> Float[Tensor, "n c h w"]:
        rectified = F.relu(x)
        # In place: no gradient needs the result of a convolution.
        return self.conv2(F.relu_(self.conv1(rectified))).add_(rectified)


class Fusion(nn.Module):
    """Add a finer level to the coarser result, refine, resize; the coarsest block has no level to add."""

    def __init__(self, features: int, joins: bool):
        super().__init__()
        if joins:
            self.resConfUnit1 = ResidualUnit(features)
        self.resConfUnit2 = ResidualUnit(features)
        self.out_conv = nn.Conv2d(features, features, 1)

    def forward(
        self,
        x: Float[Tensor, "n c h w"],
        level: Float[Tensor, "n c h w"] | None,
        size: tuple[int, int],
    ) -> Float[Tensor, "n c h2 w2"]:
        if level is not None:
            x = self.resConfUnit1(level).add_(x)
        # A 1x1 convolution commutes with interpolation; before it, it costs a quarter.
        return _resize(_pointwise(self.out_conv, self.resConfUnit2(x)), size)


class Scratch(nn.Module):
    """Everything after the resize layers, under its published names."""

    def __init__(self, out_channels: Sequence[int], features: int, hidden: int, output_dim: int):
        super().__init__()
        for i, channels in enumerate(out_channels, start=1):
            setattr(self, f"layer{i}_rn", _conv3(channels, features, bias=False))
            setattr(self, f"refinenet{i}", Fusion(features, joins=i < LEVELS))
        self.output_conv1 = _conv3(features, features // 2)
        self.output_conv2 = nn.Sequential(
            _conv3(features // 2, hidden), nn.ReLU(), nn.Conv2d(hidden, output_dim, 1)
        )


class DPTHead(nn.Module):
    """Tokens of four layers to ``output_dim`` raw channels for each pixel.

    Args:
        dim_in: width of a token of ``Tokens.latent``.
        features: channels of the fused maps (a multiple of 8).
        out_channels: channels of the four levels (multiples of 4), fine to coarse.
        output_dim: channels of the result; activations are the caller's.
        hidden: channels before the last convolution (32 as published).
        guide_channels: of a guide at full resolution (:mod:`ghgs_lit.heads.guide`), which keeps a small head
            sharp; 0: none, as published.
    """

    def __init__(
        self,
        dim_in: int,
        features: int,
        out_channels: Sequence[int],
        output_dim: int,
        hidden: int = 32,
        guide_channels: int = 0,
    ):
        super().__init__()
        require(features % 8 == 0, "features", "a multiple of 8", features)
        require(
            len(out_channels) == LEVELS and all(c % 4 == 0 for c in out_channels),
            "out_channels",
            "four multiples of 4",
            list(out_channels),
        )
        self.full_channels = features // 2
        c0, c1, _, c3 = out_channels
        self.norm = nn.LayerNorm(dim_in, eps=NORM_EPS)
        self.projects = nn.ModuleList(nn.Conv2d(dim_in, c, 1) for c in out_channels)
        self.resize_layers = nn.ModuleList(
            (
                nn.ConvTranspose2d(c0, c0, 4, stride=4),
                nn.ConvTranspose2d(c1, c1, 2, stride=2),
                nn.Identity(),
                nn.Conv2d(c3, c3, 3, stride=2, padding=1),
            )
        )
        self.scratch = Scratch(out_channels, features, hidden, output_dim)
        self.guide = GuidePyramid(guide_channels, features) if guide_channels else None

    def forward(
        self, tokens: Tokens, guide: Float[Tensor, "b v k H W"] | None = None
    ) -> Float[Tensor, "bv o H W"]:
        """Raw maps of all images, float32 or wider.

        Without a gradient the images go through the head in parts of equal size, to save memory.

        Args:
            tokens: of four layers.
            guide: where ``guide_channels`` is not 0.
        """
        require(len(tokens.latent) == LEVELS, "tokens.latent", "four layers", len(tokens.latent))
        expected = "none" if self.guide is None else "a map"
        require((guide is None) == (self.guide is None), "guide", expected, guide is not None)
        levels = self._levels(tokens)
        flat = None if guide is None else guide.flatten(0, 1)
        count = levels[0].shape[0]
        if torch.is_grad_enabled():
            return self._decode(levels, tokens.patch_size, flat)
        height, width = (n * tokens.patch_size for n in tokens.grid[2:])
        maps = None
        for part in even_parts(count, _LARGEST // (self.full_channels * height * width)):
            guides = None if flat is None else flat[part]
            found = self._decode([level[part] for level in levels], tokens.patch_size, guides)
            if len(found) == count:
                return found
            if maps is None:  # channels innermost, as the parts have them
                maps = found.new_empty(count, height, width, found.shape[1]).permute(0, 3, 1, 2)
            maps[part] = found
        return maps

    def _levels(self, tokens: Tokens) -> list[Float[Tensor, "bv c h w"]]:
        """Normalised and projected tokens on the grid (a 1x1 convolution is a linear layer of tokens)."""
        levels = []
        for latent, project in zip(tokens.latent, self.projects, strict=True):
            projected = linear(self.norm(latent), project.weight.flatten(1), project.bias)
            levels.append(dataclasses.replace(tokens, latent=(projected,)).maps(0))
        return levels

    def _decode(
        self, levels: list[Tensor], patch_size: int, guide: Tensor | None
    ) -> Float[Tensor, "n o H W"]:
        height, width = levels[0].shape[-2:]
        aspect = width / height
        s = self.scratch
        for i, resize in enumerate(self.resize_layers):
            level = add_positions_(levels[i], aspect)
            levels[i] = getattr(s, f"layer{i + 1}_rn")(resize(level))

        if guide is not None:
            full, half, quarter = self.guide(guide)
            levels[0] = levels[0] + _resize(quarter, levels[0].shape[-2:])

        sizes = [tuple(level.shape[-2:]) for level in levels]
        x = s.refinenet4(levels[3], None, sizes[2])
        x = s.refinenet3(x, levels[2], sizes[1])
        x = s.refinenet2(x, levels[1], sizes[0])
        x = s.refinenet1(x, levels[0], (2 * sizes[0][0], 2 * sizes[0][1]))

        if guide is not None:
            x = x + _resize(half, x.shape[-2:])
        x = _resize(s.output_conv1(x), (patch_size * height, patch_size * width))
        x = add_positions_(x, aspect)
        if guide is not None:
            x = x + full
        x = s.output_conv2[:-1](x)
        # The last projection stays in float32 under autocast: depths and offsets of millimetres depend on it.
        last = s.output_conv2[-1]
        with torch.autocast(x.device.type, enabled=False):
            return _pointwise(last, x.to(last.weight.dtype))
