"""Dense prediction head (DPT): fuses four layers of tokens from coarse to fine into one map per image."""

import dataclasses
import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from ghgs_lit.errors import require
from ghgs_lit.geometry.precision import exact, without_float16
from ghgs_lit.geometry.projection import at_least_float32
from ghgs_lit.method.heads.guide import Guide, GuidePyramid
from ghgs_lit.method.plan.window import Span, Window, reach
from ghgs_lit.ops.linear import linear
from ghgs_lit.ops.pool import at_once, even_parts
from ghgs_lit.types import Tokens

SCALE = 0.1
BASE = 100.0


@lru_cache(maxsize=64)
def _axis_waves(
    channels: int, count: int, half_extent: float, dtype: torch.dtype, device: torch.device
) -> Float[Tensor, "c n"]:
    """Sines, then as many cosines, along one axis times :data:`SCALE`, in float32.

    Args:
        channels: number of waves, even.
        count: number of cells.
        half_extent: the cells cover [-half_extent, half_extent]; samples are their centres.
        dtype: dtype of the centres' positions.
        device: device of the result.
    """
    quarter = channels // 2
    exponents = torch.arange(quarter, dtype=torch.float64, device=device) / quarter
    omega = 1.0 / BASE**exponents
    bound = half_extent * (count - 1) / count
    angles = omega[:, None] * torch.linspace(-bound, bound, count, dtype=dtype, device=device).double()
    return torch.cat((angles.sin(), angles.cos())).float() * SCALE


def add_positions_(
    x: Float[Tensor, "n c h w"], aspect: float, window: Window | None = None
) -> Float[Tensor, "n c h w"]:
    """Add a position embedding in place, and return ``x``.

    The first half of the channels gets waves along the columns, the second half along the rows. The
    unit is half the diagonal of the image; samples are cell centres. The waves of each axis are
    cached (a few kilobytes); the embedding is never materialised as a map.

    Args:
        x: maps, whose number of channels is a multiple of 4.
        aspect: width / height of the image.
        window: part of whole maps that ``x`` covers; None: all.
    """
    window = window or Window.whole(tuple(x.shape[2:]))
    half = x.shape[1] // 2
    dtype = torch.float64 if x.dtype == torch.float64 else torch.float32
    diagonal = math.hypot(aspect, 1.0)
    across, down = (
        _axis_waves(half, span.full, extent / diagonal, dtype, x.device)[:, span.start : span.stop]
        for span, extent in ((window.columns, aspect), (window.rows, 1.0))
    )
    x[:, :half].add_(across[:, None, :].to(x.dtype))
    x[:, half:].add_(down[:, :, None].to(x.dtype))
    return x


LEVELS = 4
#: Cells per patch along an axis in the three finer levels; the coarsest has one cell per two patches.
CELLS = (4, 2, 1)
NORM_EPS = 1e-5
#: Channels before the last convolution, as published.
HIDDEN = 32

#: Without a gradient: largest number of values of a full-resolution map in memory, on a CPU and on a
#: GPU, and least number of rows computed at once.
_LARGEST = 1 << 21
_GPU_LARGEST = 1 << 28
_ROWS = 8


Widths = tuple[int, tuple[int, int, int, int]]


def published_widths(dim_latent: int) -> Widths:
    """Channels of the fused maps, and of the four levels from fine to coarse, in published proportions.

    1/8 of the tokens' width (a multiple of 8), and 1/8, 1/4, 1/2, 1/2 (multiples of 4). With 2048, as
    published: 256, and 256, 512, 1024, 1024.
    """
    levels = tuple(_multiple(dim_latent * part, 4) for part in (1 / 8, 1 / 4, 1 / 2, 1 / 2))
    return _multiple(dim_latent / 8, 8), levels


def _multiple(value: float, of: int) -> int:
    return max(of, of * round(value / of))


def _conv3(inputs: int, outputs: int, bias: bool = True) -> nn.Conv2d:
    return nn.Conv2d(inputs, outputs, 3, padding=1, bias=bias)


def _pointwise(conv: nn.Conv2d, x: Float[Tensor, "n c h w"]) -> Float[Tensor, "n o h w"]:
    """Apply a 1x1 convolution as a linear layer on pixels; no copy, since channels are innermost."""
    return linear(x.permute(0, 2, 3, 1), conv.weight.flatten(1), conv.bias).permute(0, 3, 1, 2)


class _Halving(nn.Conv2d):
    """Strided convolution of the coarsest level."""

    def forward(self, x: Float[Tensor, "n c h w"]) -> Float[Tensor, "n c h2 w2"]:
        if x.device.type != "cpu" or x.shape[-1] > 1:
            return super().forward(x)
        # For bfloat16 maps one cell wide, PyTorch 2.13 leaves parts of the weight's gradient unset.
        with exact("cpu"):
            return super().forward(at_least_float32(x))


class ResidualUnit(nn.Module):
    """``s + conv2(relu(conv1(relu(x))))`` with ``s = relu(x)``, or ``s = x`` without a rectified skip.

    Published weights expect a rectified skip. In training it can die: where all channels of a sum of
    levels are negative, tokens no longer affect the result and get no gradient."""

    def __init__(self, features: int, rectified_skip: bool = True):
        super().__init__()
        self.conv1 = _conv3(features, features)
        self.conv2 = _conv3(features, features)
        self.rectified_skip = rectified_skip

    def forward(self, x: Float[Tensor, "n c h w"]) -> Float[Tensor, "n c h w"]:
        rectified = F.relu(x)
        # In place: the backward pass does not need results of convolutions.
        return self.conv2(F.relu_(self.conv1(rectified))).add_(rectified if self.rectified_skip else x)


class Fusion(nn.Module):
    """Adds a finer level to the coarser result and refines the sum; the coarsest block only refines."""

    def __init__(self, features: int, joins: bool, rectified_skip: bool):
        super().__init__()
        if joins:
            self.resConfUnit1 = ResidualUnit(features, rectified_skip)
        self.resConfUnit2 = ResidualUnit(features, rectified_skip)
        self.out_conv = nn.Conv2d(features, features, 1)

    def forward(
        self, x: Float[Tensor, "n c h w"] | None, level: Float[Tensor, "n c h2 w2"], place: "LevelWindows"
    ) -> Float[Tensor, "n c h w"]:
        """Refine the sum of the coarser result and a level in the window ``place.joined``.

        Args:
            x: the coarser result in this window, which may be overwritten; None for the coarsest
                level.
            level: map of the level in the window ``place.level``.
            place: windows of the level.
        """
        if x is not None:
            level = self.resConfUnit1(level)
        level = place.level.cut(level, place.joined)
        x = self.resConfUnit2(level if x is None else x.add_(level))
        # A 1x1 convolution commutes with interpolation; applied before, it has a quarter of the cost.
        return _pointwise(self.out_conv, x)


class Scratch(nn.Module):
    """Layers after the resize layers, under their published names.

    Args:
        out_channels: channels of the levels, from fine to coarse.
        features: channels of the fused maps.
        hidden: channels before the last convolution.
        output_dim: channels of the result.
        rectified_skip: as in :class:`ResidualUnit`.
    """

    def __init__(
        self, out_channels: Sequence[int], features: int, hidden: int, output_dim: int, rectified_skip: bool
    ):
        super().__init__()
        for i, channels in enumerate(out_channels, start=1):
            setattr(self, f"layer{i}_rn", _conv3(channels, features, bias=False))
            setattr(self, f"refinenet{i}", Fusion(features, i < LEVELS, rectified_skip))
        self.output_conv1 = _conv3(features, features // 2)
        hidden_layer = _conv3(features // 2, hidden)
        last = nn.Conv2d(hidden, output_dim, 1)
        self.output_conv2 = nn.Sequential(hidden_layer, nn.ReLU(), last)


@dataclass(frozen=True)
class LevelWindows:
    """Windows of a level: of its tokens, of its map, and of the sum with the coarser result."""

    tokens: Window
    level: Window
    joined: Window


@dataclass(frozen=True)
class Windows:
    """Windows of intermediate maps that a head computes for the window ``result`` of its output.

    Zero padding corrupts the border of a window, so each is enlarged by the receptive field of its
    layers, clipped to the map."""

    result: Window
    full: Window
    fused: Window
    levels: tuple[LevelWindows, ...]


class DPTHead(nn.Module):
    """Tokens of four layers to raw channels for each pixel, without activation (DPT, ICCV 2021).

    Args:
        dim_latent: width of a token of ``Tokens.latent``.
        output_dim: channels of the result.
        rectified_skip: as in :class:`ResidualUnit`.
        guide_channels: channels of a full-resolution guide (:mod:`ghgs_lit.method.heads.guide`), which
            keeps a small head sharp; 0: no guide, as published.
        widths: internal channels; None: :func:`published_widths`.
    """

    def __init__(
        self,
        dim_latent: int,
        output_dim: int,
        rectified_skip: bool = True,
        guide_channels: int = 0,
        widths: Widths | None = None,
    ):
        super().__init__()
        features, out_channels = widths or published_widths(dim_latent)
        self.full_channels = features // 2
        c0, c1, _, c3 = out_channels
        self.norm = nn.LayerNorm(dim_latent, eps=NORM_EPS)
        self.projects = nn.ModuleList(nn.Conv2d(dim_latent, c, 1) for c in out_channels)
        larger = nn.ConvTranspose2d(c0, c0, 4, stride=4), nn.ConvTranspose2d(c1, c1, 2, stride=2)
        smaller = _Halving(c3, c3, 3, stride=2, padding=1)
        self.resize_layers = nn.ModuleList((*larger, nn.Identity(), smaller))
        self.scratch = Scratch(out_channels, features, HIDDEN, output_dim, rectified_skip)
        self.guide = GuidePyramid(guide_channels, features) if guide_channels else None

    def forward(
        self, tokens: Tokens, guide: Guide | None = None, window: Window | None = None
    ) -> Float[Tensor, "bv o h w"]:
        """Raw maps of all images, in float32 or wider; float16 autocast is disabled.

        Args:
            tokens: tokens of four layers.
            guide: maps of whole images, if ``guide_channels`` is not 0.
            window: part of the maps to compute, in pixels; None: all.

        Raises:
            InputError: tokens do not have four layers.
        """
        require(len(tokens.latent) == LEVELS, "tokens.latent", "four layers", len(tokens.latent))
        with without_float16(tokens.semantic.device.type):
            return self._maps(tokens, guide, window)

    def _maps(self, tokens: Tokens, guide: Guide | None, window: Window | None) -> Tensor:
        """:meth:`forward` in the current precision."""
        rows, columns = tokens.grid[2:]
        size = (tokens.patch_size * rows, tokens.patch_size * columns)
        windows = self.windows(window or Window.whole(size), (rows, columns))
        aspect = columns / rows
        s = self.scratch
        full = None
        if guide is not None:
            targets = (windows.full, windows.fused, windows.levels[0].level)
            full, half, quarter = self.guide(guide, targets)

        x = None
        # Coarse to fine, one level at a time: coarse levels have large weights, fine ones large maps.
        for i in reversed(range(LEVELS)):
            place = windows.levels[i]
            level = self._level(i, tokens, place)
            if guide is not None and i == 0:
                level = level + quarter
            x = getattr(s, f"refinenet{i + 1}")(x, level, place)
            x = place.joined.resize(x, windows.levels[i - 1].joined if i else windows.fused)

        if guide is not None:
            x = x + half
        x = s.output_conv1(x)
        finest = functools.partial(self._finest, x, full, windows, aspect)
        return torch.cat([finest(part) for part in self._parts(x, windows.result)], 2)

    def _finest(
        self,
        x: Float[Tensor, "n c h w"],
        guide: Float[Tensor, "n c h2 w2"] | None,
        windows: Windows,
        aspect: float,
        result: Window,
    ) -> Float[Tensor, "n o h3 w3"]:
        """Compute the window ``result`` of the output from the map ``x`` in ``windows.fused``, before the
        last interpolation; ``guide`` covers ``windows.full``."""
        layers = self.scratch.output_conv2
        seen = result.grow(reach(layers))
        x = add_positions_(windows.fused.resize(x, seen), aspect, seen)
        if guide is not None:
            x = x + windows.full.cut(guide, seen)
        x = layers[:-1](x)
        # In float32 even under autocast: depths and offsets must be accurate to millimetres.
        last = layers[-1]
        with exact(x.device.type):
            return seen.cut(_pointwise(last, x.to(last.weight.dtype)), result)

    def _parts(self, x: Float[Tensor, "n c h w"], window: Window) -> list[Window]:
        """Split a window along its rows; without a gradient, these largest maps are computed in turn."""
        if torch.is_grad_enabled():
            return [window]
        rows, columns = window
        row = x.shape[0] * x.shape[1] * (columns.stop - columns.start)
        most = at_once(x.device, _LARGEST, _GPU_LARGEST)
        parts = even_parts(rows.stop - rows.start, max(_ROWS, most // row))
        return [Window(Span(rows.start + p.start, rows.start + p.stop, rows.full), columns) for p in parts]

    def windows(self, result: Window, grid: tuple[int, int]) -> Windows:
        """Windows of each level, from fine to coarse, that a window of the output depends on.

        Args:
            result: window of the output, in pixels.
            grid: rows and columns of patches.
        """
        s = self.scratch
        full = result.grow(reach(s.output_conv2))
        fused = full.sources(_times(2 * CELLS[0], grid)).grow(reach(s.output_conv1))
        target = fused
        levels = []
        for i, resize in enumerate(self.resize_layers):
            fusion = getattr(s, f"refinenet{i + 1}")
            size = _times(CELLS[i], grid) if i < len(CELLS) else tuple(-(-n // 2) for n in grid)
            joined = target.sources(size).grow(reach(fusion.resConfUnit2))
            level = joined.grow(reach(getattr(s, f"layer{i + 1}_rn"), fusion) - reach(fusion.resConfUnit2))
            if i < len(CELLS):
                tokens = level.coarser(CELLS[i])
                level = tokens.finer(CELLS[i], size)
            else:
                level = level.grow(reach(resize))
                tokens = level.finer(2, grid)
            levels.append(LevelWindows(tokens, level, joined))
            target = joined
        return Windows(result, full, fused, tuple(levels))

    def _level(self, i: int, tokens: Tokens, place: LevelWindows) -> Float[Tensor, "bv c h w"]:
        """Map of level ``i`` (0: finest) in ``place.level``, with the channels of the fused maps."""
        aspect = tokens.grid[3] / tokens.grid[2]
        if tokens.is_dense:  # slicing drops tokens outside the window without a copy
            b, v, *grid = tokens.grid
            inside = tokens.latent[i].unflatten(0, (b * v, *grid))[:, *place.tokens.slices]
            maps = self._project(i, inside).permute(0, 3, 1, 2)
        else:
            projected = dataclasses.replace(tokens, latent=(self._project(i, tokens.latent[i]),))
            maps = projected.maps(0)[..., *place.tokens.slices]
        level = self.resize_layers[i](add_positions_(maps, aspect, place.tokens))
        return getattr(self.scratch, f"layer{i + 1}_rn")(level)

    def _project(self, i: int, x: Float[Tensor, "*n c"]) -> Float[Tensor, "*n o"]:
        """Normalise and project tokens; the published 1x1 convolution is a linear layer on tokens."""
        project = self.projects[i]
        if not torch.is_autocast_enabled(x.device.type):
            x = x.to(project.weight.dtype)  # tokens of an encoder under float16 autocast
        return linear(self.norm(x), project.weight.flatten(1), project.bias)


def _times(factor: int, grid: tuple[int, int]) -> tuple[int, int]:
    return factor * grid[0], factor * grid[1]
