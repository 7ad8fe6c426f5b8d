"""The Gaussian stage: one Gaussian for each pixel of the subject (paper, section 3.3)."""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import log

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

from ghgs_lit.errors import choice, require
from ghgs_lit.geometry.mattes import surface_colors
from ghgs_lit.geometry.photo_consistency import photo_consistency
from ghgs_lit.geometry.projection import at_least_float32
from ghgs_lit.geometry.relative_depth import relative_depth
from ghgs_lit.geometry.rotations import multiply_quaternions, rotate
from ghgs_lit.geometry.vectors import unit
from ghgs_lit.heads.activations import bounded_sigmoid, bounded_tanh
from ghgs_lit.heads.dense import Part, decode, proportioned_dpt
from ghgs_lit.heads.guide import PHOTO_CHANNELS, Guide, photo_guide
from ghgs_lit.heads.surface import surface_axes
from ghgs_lit.heads.window import subject_windows
from ghgs_lit.kernels.linear import Linear
from ghgs_lit.kernels.precision import without_float16
from ghgs_lit.types import Batch, DepthBounds, DepthMaps, Gaussians, Points, Tokens, true_places

Attributes = tuple[Tensor, Tensor, Tensor, Tensor]

#: The gradient of a shorter quaternion is that of this length: it would grow without bound near 0.
_SHORTEST = 0.1


def _logit(probability: float) -> float:
    return log(probability / (1 - probability))


def _mlp(sizes: Sequence[int], activation: type[nn.Module]) -> nn.Sequential:
    layers: list[nn.Module] = []
    for inputs, outputs in pairwise(sizes):
        layers += [Linear(inputs, outputs), activation()]
    return nn.Sequential(*layers[:-1])


def float32_last(mlp: nn.Sequential, x: Tensor) -> Tensor:
    """``mlp(x)``, its last projection in float32 under autocast: offsets of millimetres depend on it.

    Under float16 autocast all of it, as the dense head before it.
    """
    with without_float16(x.device.type):
        hidden, last = mlp[:-1](x), mlp[-1]
    with torch.autocast(x.device.type, enabled=False):
        return at_least_float32(last(hidden.to(last.weight.dtype)))


#: Widths of a Gaussian's raw offset, scale, rotation, opacity and color, and their sum.
_WIDTHS = (3, 3, 4, 1, 3)
RAW_VALUES = sum(_WIDTHS)


@dataclass(frozen=True)
class RawGaussians:
    """Attributes before their activations, and the descriptors that they come from."""

    descriptors: Float[Tensor, "N c"]
    offset: Float[Tensor, "N 3"]
    scale: Float[Tensor, "N 3"]
    rotation: Float[Tensor, "N 4"]
    opacity: Float[Tensor, " N"]
    color: Float[Tensor, "N 3"] | None
    image: Int[Tensor, " N"]
    pixel: Int[Tensor, " N"]
    splits: tuple[int, ...]

    def changed(self, change: Float[Tensor, "N c"]) -> "RawGaussians":
        """With :data:`RAW_VALUES` of each added to offset, scale, rotation, opacity and color."""
        offset, scale, rotation, opacity, color = change.split(_WIDTHS, -1)
        return dataclasses.replace(
            self,
            offset=self.offset + offset,
            scale=self.scale + scale,
            rotation=self.rotation + rotation,
            opacity=self.opacity + opacity[:, 0],
            color=None if self.color is None else self.color + color,
        )


class FootprintAttributes:
    """Raw values to attributes in units of a pixel's footprint; raw zeros give a splat on the surface.

    A pixel's footprint is ``z / f`` metres.

    Args:
        offset_limit: largest offset along each axis, in metres.
        scale_floor: least scale in footprints; it leaves no holes when splats are rendered at a higher
            resolution.
        scale_cap: largest scale in footprints.
        scale_start: scale in footprints at which training starts.
        thickness_start: the same of the third axis (None: as the others).
        inward: distance in footprints along the third axis to which training starts moving the splats: with
            axes of the surface, away from the camera. What a splat covers beside its pixel then ends at the
            silhouette.
        opacity_floor: least opacity: below 1/255 a splat has no gradient left.
        opacity_start: opacity at which training starts.
    """

    def __init__(
        self,
        offset_limit: float = 0.05,
        scale_floor: float = 0.15,
        scale_cap: float = 4.0,
        scale_start: float = 0.3,
        thickness_start: float | None = None,
        inward: float = 0.0,
        opacity_floor: float = 0.1,
        opacity_start: float = 0.9,
    ):
        key = "gaussian_head.attributes"
        require(offset_limit >= 0, f"{key}.offset_limit", "0 or more metres", offset_limit)
        thickness_start = scale_start if thickness_start is None else thickness_start
        starts = {"scale_start": scale_start, "thickness_start": thickness_start}
        for name, start in starts.items():
            expected = f"0 < scale_floor < {name} < scale_cap"
            found = (scale_floor, start, scale_cap)
            require(0 < scale_floor < start < scale_cap, f"{key}.{name}", expected, found)
        require(inward >= 0, f"{key}.inward", "0 or more footprints", inward)
        require(
            0 <= opacity_floor < opacity_start < 1,
            f"{key}.opacity_start",
            "0 <= opacity_floor < opacity_start < 1",
            (opacity_floor, opacity_start),
        )
        self.offset_limit, self.scale_floor, self.opacity_floor = offset_limit, scale_floor, opacity_floor
        self.scale_range = log(scale_cap / scale_floor)
        self.scale_bias, self.thickness_bias = (
            _logit(log(start / scale_floor) / self.scale_range) for start in starts.values()
        )
        self.inward = inward
        self.opacity_bias = _logit((opacity_start - opacity_floor) / (1 - opacity_floor))

    def __call__(
        self,
        offset: Float[Tensor, "N 3"],
        scale: Float[Tensor, "N 3"],
        rotation: Float[Tensor, "N 4"],
        opacity: Float[Tensor, " N"],
        footprint: Float[Tensor, " N"],
    ) -> Attributes:
        identity = F.pad(rotation.new_ones(1), (0, 3))
        scale = torch.cat((scale[:, :2] + self.scale_bias, scale[:, 2:] + self.thickness_bias), 1)
        scale = self.scale_floor * torch.exp(self.scale_range * bounded_sigmoid(scale))
        shown = bounded_sigmoid(opacity + self.opacity_bias)
        return (
            self.offset_limit * bounded_tanh(offset) + F.pad(self.inward * footprint[:, None], (2, 0)),
            footprint[:, None] * scale,
            unit(identity + rotation, _SHORTEST),
            self.opacity_floor + (1 - self.opacity_floor) * shown,
        )


def release_attributes(
    offset: Float[Tensor, "N 3"],
    scale: Float[Tensor, "N 3"],
    rotation: Float[Tensor, "N 4"],
    opacity: Float[Tensor, " N"],
    footprint: Float[Tensor, " N"],
) -> Attributes:
    """As in the authors' release: offsets and scales in metres, without bound."""
    return offset, F.softplus(scale, beta=100), unit(rotation), opacity.sigmoid()


class GaussianHead(nn.Module):
    """A dense head over the recalibrated tokens, then four small networks for each pixel of the subject.

    Colours are the input pixels', unless ``color_limit`` lets them change. Published names of the networks:
    ``offset_header``, ``scale_header``, ``rot_header``, ``opacity_header``, with linear layers 0, 2 and 4.

    Args:
        dim_latent: width of the tokens (from the encoder).
        dpt: options of the dense head; widths that are not given follow the encoder's.
        channels: of the dense head's result, a descriptor of each pixel.
        hidden: two widths inside the four networks.
        parameterization: ``footprint`` (:class:`FootprintAttributes`, raw values start at 0) or
            ``release`` (:func:`release_attributes`, PyTorch's initialisation).
        attributes: options of :class:`FootprintAttributes`.
        axes: of offsets, scales and rotations: those of the ``world``, or of the ``surface`` around each
            pixel's depth (:func:`surface_axes`), which look alike from every camera.
        pixels: ``subject`` decodes windows around the subject and runs the four networks on its pixels,
            ``all`` computes every pixel and selects afterwards; the Gaussians are the same.
        guide: let the dense head see photographs, masks and depths at full resolution.
        photo_consistency: the guide also shows the :func:`photo_consistency` at the predicted depth: a splat
            off the surface can become transparent.
        color_limit: largest change of a colour from its pixel's, in each channel, which makes up for the blur
            of splats and for dark rims; 0: none (the paper).
        low_pass, antialiased: of the :class:`ghgs_lit.types.Gaussians`.
    """

    def __init__(
        self,
        dim_latent: int,
        dpt: Mapping | None = None,
        channels: int = 32,
        hidden: Sequence[int] = (128, 32),
        parameterization: str = "footprint",
        attributes: Mapping | None = None,
        axes: str = "world",
        pixels: str = "subject",
        guide: bool = False,
        photo_consistency: bool = False,
        color_limit: float = 0.0,
        low_pass: float = 0.3,
        antialiased: bool = False,
    ):
        super().__init__()
        choice("gaussian_head.parameterization", parameterization, ("footprint", "release"))
        choice("gaussian_head.pixels", pixels, ("subject", "all"))
        choice("gaussian_head.axes", axes, ("world", "surface"))
        require(len(hidden) == 2, "gaussian_head.hidden", "two widths", list(hidden))
        allowed = guide or not photo_consistency
        require(allowed, "gaussian_head.photo_consistency", "false where there is no guide", True)
        require(low_pass >= 0, "gaussian_head.low_pass", "0 or more", low_pass)
        require(color_limit >= 0, "gaussian_head.color_limit", "0 or more", color_limit)
        self.pixels, self.axes = pixels, axes
        self.low_pass, self.antialiased = low_pass, antialiased
        self.photo_consistency, self.color_limit = photo_consistency, color_limit
        guided = PHOTO_CHANNELS + 1 + photo_consistency if guide else 0
        self.decoder = proportioned_dpt(dim_latent, channels, guide_channels=guided, **(dpt or {}))
        self.offset_header = _mlp((channels, *hidden, 3), nn.Tanh)
        self.scale_header = _mlp((channels, *hidden, 3), nn.ReLU)
        self.rot_header = _mlp((channels, *hidden, 4), nn.ReLU)
        self.opacity_header = _mlp((channels, *hidden, 1), nn.ReLU)
        headers = [self.offset_header, self.scale_header, self.rot_header, self.opacity_header]
        from_zero = []
        if color_limit > 0:
            self.color_header = _mlp((channels, *hidden, 3), nn.ReLU)
            headers.append(self.color_header)
            from_zero.append(self.color_header)
        self.attributes = release_attributes
        if parameterization == "footprint":
            self.attributes = FootprintAttributes(**(attributes or {}))
            from_zero = headers
        for header in from_zero:
            nn.init.zeros_(header[-1].weight)
            nn.init.zeros_(header[-1].bias)

    def forward(self, tokens: Tokens, batch: Batch, points: Points, depth_maps: DepthMaps) -> RawGaussians:
        """Raw attributes of the valid pixels in the order of element, view, row, column.

        Args:
            tokens: recalibrated.
            batch: images, masks and cameras are read.
            points: of the pixels.
            depth_maps: of the same pixels.
        """
        views, height, width = points.valid.shape[1:]
        counts = points.valid.flatten(0, 1).sum((1, 2)).tolist()
        places = true_places(points.valid, sum(counts))
        image, pixel = places // (height * width), places % (height * width)
        windows = None if self.pixels == "all" else subject_windows(batch.extents, (height, width))
        parts = decode(self.decoder, tokens, self._guide(batch, points, depth_maps), windows)
        raw = zip(*(self._of_subject(part, image, pixel, counts) for part in parts), strict=True)
        values = [torch.cat(values) for values in raw]
        splits = tuple(sum(counts[first : first + views]) for first in range(0, len(counts), views))
        return RawGaussians(*values[:5], values[5] if len(values) > 5 else None, image, pixel, splits)

    def activate(self, raw: RawGaussians, batch: Batch, points: Points, depth_maps: DepthMaps) -> Gaussians:
        """The Gaussians of raw attributes at the points of their pixels; arguments as of :meth:`forward`."""
        image, pixel = raw.image, raw.pixel
        focal = (
            at_least_float32(batch.cameras.intrinsics)
            .diagonal(dim1=-2, dim2=-1)[..., :2]
            .prod(-1)
            .sqrt()
            .flatten()[image]
        )
        depth = depth_maps.depth.flatten(0, 1).flatten(1)[image, pixel]
        # Without a gradient: a splat that is too large must not move nearer to become smaller.
        footprint = depth.detach() / focal
        offset, scales, quaternions, opacities = self.attributes(
            raw.offset, raw.scale, raw.rotation, raw.opacity, footprint
        )
        if self.axes == "surface":
            axes = surface_axes(depth_maps, batch.cameras, image, pixel)
            offset, quaternions = rotate(axes, offset), multiply_quaternions(axes, quaternions)
        if batch.alpha is not None:
            opacities = opacities * batch.alpha.to(opacities).flatten(0, 1).flatten(1)[image, pixel]
        colors = batch.once(surface_colors).flatten(0, 1).flatten(2).transpose(1, 2)[image, pixel]
        return Gaussians(
            means=points.pixels.flatten(0, 1).flatten(1, 2)[image, pixel] + offset,
            quaternions=quaternions,
            scales=scales,
            opacities=opacities,
            colors=colors if raw.color is None else colors + self.color_limit * bounded_tanh(raw.color),
            splits=raw.splits,
            image=image,
            pixel=pixel,
            low_pass=self.low_pass,
            antialiased=self.antialiased,
        )

    def _guide(self, batch: Batch, points: Points, depth_maps: DepthMaps) -> Guide | None:
        if self.decoder.guide is None:
            return None
        maps = [relative_depth(at_least_float32(depth_maps.depth), points.valid)]
        if self.photo_consistency:
            depth = at_least_float32(depth_maps.depth.detach())
            maps.append(photo_consistency(batch, DepthBounds(depth, depth), 1))
        return photo_guide(batch, *maps)

    def _of_subject(
        self, part: Part, image: Int[Tensor, " N"], pixel: Int[Tensor, " N"], counts: Sequence[int]
    ) -> Sequence[Tensor]:
        """Descriptors and raw values (:meth:`_raw`) of a part at its pixels; each image has ``counts``."""
        descriptors, begin = part.maps.permute(0, 2, 3, 1), part.images.start
        own = slice(sum(counts[:begin]), sum(counts[: part.images.stop]))
        (top, _, _), (left, _, width) = part.window
        row, column = pixel[own] // width - top, pixel[own] % width - left
        if self.pixels == "subject":
            chosen = descriptors[image[own] - begin, row, column]
            return chosen, *self._raw(chosen)
        # One image at a time: the networks' hidden layers are wider than the maps.
        places = zip(*(place.split(counts[part.images]) for place in (row, column)), strict=True)
        each = [
            [values[place] for values in (maps, *self._raw(maps))]
            for maps, place in zip(descriptors, places, strict=True)
        ]
        return [torch.cat(values) for values in zip(*each, strict=True)]

    def _raw(self, descriptors: Float[Tensor, "*n c"]) -> tuple[Tensor, ...]:
        """Raw offset, scale, rotation, opacity and, where there is a network for it, color."""
        headers = [self.offset_header, self.scale_header, self.rot_header, self.opacity_header]
        if self.color_limit > 0:
            headers.append(self.color_header)
        offset, scale, rotation, opacity, *color = (float32_last(header, descriptors) for header in headers)
        return offset, scale, rotation, opacity[..., 0], *color
