"""The Gaussian stage: one Gaussian for each pixel of the subject (paper, section 3.3)."""

from collections.abc import Sequence
from itertools import pairwise
from typing import Literal

import torch
from jaxtyping import Float, Int
from pydantic import model_validator
from torch import Tensor, nn

from ghgs_lit.config.options import Amount, Options, Positive, Share, Width
from ghgs_lit.geometry.masks import relative_depth, surface_colors
from ghgs_lit.geometry.precision import exact, without_float16
from ghgs_lit.geometry.projection import at_least_float32
from ghgs_lit.method.heads.attributes import (
    OFFSET_UNIT,
    FootprintAttributes,
    RawGaussians,
    release_attributes,
)
from ghgs_lit.method.heads.dense import Part, decode
from ghgs_lit.method.heads.dpt import DPTHead
from ghgs_lit.method.heads.guide import PHOTO_CHANNELS, Guide, photo_guide
from ghgs_lit.method.plan import Plan
from ghgs_lit.method.plan.rows import Rows
from ghgs_lit.ops.activation import (
    footprint_gaussians,
    make_gaussians,
)
from ghgs_lit.ops.linear import Linear
from ghgs_lit.ops.photo_consistency import photo_consistency
from ghgs_lit.types import (
    Batch,
    DepthBounds,
    DepthMaps,
    Gaussians,
    Points,
    Tokens,
)


def _mlp(sizes: Sequence[int], activation: type[nn.Module]) -> nn.Sequential:
    layers: list[nn.Module] = []
    for inputs, outputs in pairwise(sizes):
        layers += [Linear(inputs, outputs), activation()]
    return nn.Sequential(*layers[:-1])


def float32_last(mlp: nn.Sequential, x: Tensor) -> Tensor:
    """``mlp(x)`` with the last, linear layer in float32 under autocast, so that offsets are accurate to
    millimetres; under float16 autocast all layers are in float32."""
    with without_float16(x.device.type):
        hidden = mlp[:-1](x)
        last = mlp[-1]
    with exact(x.device.type):
        return at_least_float32(last(hidden.to(last.weight.dtype)))


class GaussianHeadOptions(Options):
    """Gaussian head: recalibrated tokens to one Gaussian per pixel of the subject."""

    group = "gaussian_head"
    rectified_skip: bool = True
    """Residual units add the rectified input, as published weights expect; in training, units can die."""
    guide: bool = False
    """Add images, masks and depths at full resolution to the input of the dense head (paper: false)."""
    photo_consistency: bool = False
    """Add photo-consistency at the predicted depth to the guide, so that a splat off the surface can
    become transparent (paper: false)."""
    color_limit: Share = 0.0
    """Largest change of a colour from its pixel's, per channel, to compensate the blur of splats and dark
    rims; 0: no change (paper)."""
    offset_limit: Positive | None = OFFSET_UNIT
    """Largest offset of a Gaussian from its pixel's point along each axis, in metres; null: no limit, as
    published. Only with parameterization=footprint."""
    low_pass: Amount = 0.3
    """Low-pass filter, in px^2, of the renderer that splats are predicted for; 0.3: gsplat's default."""
    antialiased: bool = False
    """Predict splats for a renderer that compensates the opacity added by the low-pass filter
    (Mip-Splatting)."""
    channels: Width = 32
    """Width of the descriptor of a pixel (32 as published)."""
    hidden: tuple[Width, Width] = (128, 32)
    """Hidden widths of the attribute networks (as published)."""
    parameterization: Literal["footprint", "release"] = "footprint"
    """footprint: attributes in units of a pixel's footprint, raw values initially 0; release: offsets and
    scales in metres, unbounded, PyTorch's initialisation."""
    axes: Literal["world", "surface"] = "world"
    """Axes of offsets, scales and rotations: world | surface: normal and tangents of the predicted depth,
    which look alike from every camera (not in the paper)."""
    attributes: FootprintAttributes = FootprintAttributes()
    """Options of parameterization=footprint."""

    @model_validator(mode="after")
    def _check(self) -> "GaussianHeadOptions":
        allowed = self.guide or not self.photo_consistency
        self.require(allowed, "photo_consistency", "false where there is no guide")
        return self

    def build(self, dim_latent: int) -> "GaussianHead":
        """Build the stage for tokens of width ``dim_latent``."""
        return GaussianHead(self, dim_latent)


class GaussianHead(nn.Module):
    """Dense head over the recalibrated tokens, then small networks on each pixel of the subject.

    Colours are those of the input pixels, up to changes within ``color_limit``. The names of the
    networks and their linear layers 0, 2 and 4 are the published ones."""

    def __init__(self, options: GaussianHeadOptions, dim_latent: int):
        super().__init__()
        self.options = options
        self.channels = options.channels
        channels = options.channels
        hidden = options.hidden
        guided = PHOTO_CHANNELS + 1 + options.photo_consistency if options.guide else 0
        self.decoder = DPTHead(dim_latent, channels, options.rectified_skip, guided)
        self.offset_header = _mlp((channels, *hidden, 3), nn.Tanh)
        self.scale_header = _mlp((channels, *hidden, 3), nn.ReLU)
        self.rot_header = _mlp((channels, *hidden, 4), nn.ReLU)
        self.opacity_header = _mlp((channels, *hidden, 1), nn.ReLU)
        headers = [self.offset_header, self.scale_header, self.rot_header, self.opacity_header]
        from_zero = []
        if options.color_limit > 0:
            self.color_header = _mlp((channels, *hidden, 3), nn.ReLU)
            headers.append(self.color_header)
            from_zero.append(self.color_header)
        self.attributes = release_attributes
        if options.parameterization == "footprint":
            self.attributes = options.attributes
            from_zero = headers
        for header in from_zero:
            nn.init.zeros_(header[-1].weight)
            nn.init.zeros_(header[-1].bias)

    def forward(
        self,
        tokens: Tokens,
        batch: Batch,
        points: Points,
        depth_maps: DepthMaps,
        plan: Plan,
    ) -> RawGaussians:
        """Predict raw attributes of the subject's pixels with a valid point, ordered by element, view, row,
        column.

        Args:
            tokens: recalibrated tokens.
            batch: images, masks and cameras are read.
            points: define the pixels with a valid point.
            depth_maps: in metres, used by a guide.
            plan: selects windows and pixels to compute; with ``pixels="all"`` every pixel is computed
                first, with the same result.
        """
        views, height, width = points.valid.shape[1:]
        rows = plan.subject.only(points.valid)
        image = rows.index // (height * width)
        pixel = rows.index % (height * width)
        guide = self._guide(batch, points, depth_maps)
        parts = decode(self.decoder, tokens, guide, plan.windows, plan.together)
        everywhere = plan.pixels == "all"
        raw = zip(*(self._of_part(part, image, pixel, rows, everywhere) for part in parts), strict=True)
        values = [torch.cat(of_parts) for of_parts in raw]
        color = values[5] if len(values) > 5 else None
        return RawGaussians(*values[:5], color, image, pixel, rows.splits(views), rows.real)

    def activate(self, raw: RawGaussians, batch: Batch, points: Points, depth_maps: DepthMaps) -> Gaussians:
        """Convert raw attributes to Gaussians at the points of their pixels.

        Args:
            raw: from :meth:`forward`, possibly changed by rounds.
            batch: images, mattes and cameras are read.
            points: points of pixels in the world, in metres.
            depth_maps: depths of these points, in metres.
        """
        numbers = (raw.offset, raw.scale, raw.rotation, raw.opacity, raw.color)
        photo = batch.once(surface_colors)
        share = batch.alpha
        options = self.options
        given = (numbers, raw.image, raw.pixel, depth_maps, points.pixels, photo, share, batch.cameras)
        on_surface = options.axes == "surface"
        if not isinstance(self.attributes, FootprintAttributes):
            fields = make_gaussians(*given, self.attributes, options.color_limit, on_surface)
        else:
            constants = self.attributes.constants(options.offset_limit, options.color_limit)
            fields = footprint_gaussians(*given, constants, on_surface)
        if raw.real is not None:
            fields = (*fields[:3], fields[3] * raw.real, *fields[4:])
        constants = {"low_pass": options.low_pass, "antialiased": options.antialiased}
        return Gaussians(*fields, raw.splits, raw.image, raw.pixel, **constants)

    def _guide(self, batch: Batch, points: Points, depth_maps: DepthMaps) -> Guide | None:
        """Guide with relative depths and, optionally, photo-consistency; None for a head without one."""
        if self.decoder.guide is None:
            return None
        maps = [relative_depth(at_least_float32(depth_maps.depth), points.valid)]
        if self.options.photo_consistency:
            depth = at_least_float32(depth_maps.depth.detach())
            maps.append(photo_consistency(batch, DepthBounds(depth, depth), 1))
        return photo_guide(batch, *maps)

    def _of_part(
        self, part: Part, image: Int[Tensor, " N"], pixel: Int[Tensor, " N"], rows: Rows, everywhere: bool
    ) -> Sequence[Tensor]:
        """Descriptors and raw values (:meth:`_raw`) of the subject's pixels in a part.

        Args:
            part: decoded maps of consecutive images.
            image: index ``b * V + v`` of the image of each of the subject's pixels.
            pixel: row-major indices of these pixels.
            rows: the same pixels by image.
            everywhere: compute values of every pixel first, one image at a time to save memory: hidden
                layers are wider than the maps.
        """
        within = rows.within(part.images)
        (top, _, _), (left, _, width) = part.window
        row = pixel[within] // width - top
        column = pixel[within] % width - left
        index = (image[within] - part.images.start, row, column)
        maps = part.maps.permute(0, 2, 3, 1)
        if not everywhere:
            chosen = maps[index]
            return chosen, *self._raw(chosen)
        if rows.real is not None:
            return [values[index] for values in (maps, *self._raw(maps))]
        of_images = zip(*(places.split(rows.counts[part.images]) for places in (row, column)), strict=True)
        each = []
        for own, index in zip(maps, of_images, strict=True):
            each.append([values[index] for values in (own, *self._raw(own))])
        return [torch.cat(values) for values in zip(*each, strict=True)]

    def _raw(self, descriptors: Float[Tensor, "*n c"]) -> tuple[Tensor, ...]:
        """Raw offset, scale, rotation, opacity and, with a ``color_limit``, color."""
        headers = [self.offset_header, self.scale_header, self.rot_header, self.opacity_header]
        if self.options.color_limit > 0:
            headers.append(self.color_header)
        offset, scale, rotation, opacity, *color = (float32_last(header, descriptors) for header in headers)
        return offset, scale, rotation, opacity[..., 0], *color
