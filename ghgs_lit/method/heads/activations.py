"""Activations of the raw channels of heads."""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from ghgs_lit.geometry.projection import focal_lengths
from ghgs_lit.geometry.rotations import multiply_quaternions, rotate, unit
from ghgs_lit.method.heads.surface import surface_axes
from ghgs_lit.types import Cameras, DepthMaps


class _Saturate(torch.autograd.Function):
    """A sigmoid or tanh whose argument is clamped; see :func:`bounded_sigmoid`."""

    @staticmethod
    def forward(ctx, x: Tensor, limit: float, symmetric: bool) -> Tensor:
        """The activation of ``x`` within its limit.

        Args:
            ctx: of autograd.
            x: raw values.
            limit: largest argument.
            symmetric: tanh instead of sigmoid.
        """
        ctx.save_for_backward(x)
        ctx.limit = limit
        ctx.symmetric = symmetric
        stopped = x.clamp(-limit, limit)
        return stopped.tanh() if symmetric else stopped.sigmoid()

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, slope: Tensor):
        (x,) = ctx.saved_tensors
        stopped = x.clamp(-ctx.limit, ctx.limit)
        # Not y (1 - y), which has few exact digits where y is nearly 1.
        if ctx.symmetric:
            own = stopped.cosh().square().reciprocal()
        else:
            own = stopped.sigmoid() * (-stopped).sigmoid()
        # Gradient descent subtracts, so a gradient with the sign of x leads back into the limits.
        leads_back = (stopped == x) | (slope * x > 0)
        return torch.where(leads_back, slope * own, 0), None, None


#: Largest arguments of the activations; sigmoid and tanh have slopes of 4.5e-5 and 1.8e-4 there.
SIGMOID_LIMIT = 10.0
TANH_LIMIT = 5.0
EXP_LIMIT = 80.0


def bounded_sigmoid(x: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """The sigmoid of ``x`` clamped to +-10; beyond,
    only gradients that lead back into the limits remain.

    In float32 a plain sigmoid is exactly 1 from 17 on, without a gradient: one step that is too
    large ends the training of a head.
    """
    return _Saturate.apply(x, SIGMOID_LIMIT, False)


def bounded_tanh(x: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """The hyperbolic tangent of ``x`` clamped to +-5,
    with gradients as of :func:`bounded_sigmoid`."""
    return _Saturate.apply(x, TANH_LIMIT, True)


def confidence_of(raw: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """A confidence of at least 1, as in published heads (VGGT),
    finite for any raw value but NaN."""
    return 1 + raw.clamp(max=EXP_LIMIT).exp()


#: The gradient of shorter quaternions is that of this length: it would grow without bound near 0.
SHORTEST = 0.1

Attributes = tuple[Tensor, Tensor, Tensor, Tensor]


class Constants(NamedTuple):
    """Numbers of :func:`footprint_attributes`.
    Lengths are in footprints, except those of offsets."""

    offset_limit: float
    """Largest offset along each axis in metres; 0: none."""
    offset_unit: float
    """Offset in metres for a raw value of 1 where there is no limit."""
    inward: float
    scale_floor: float
    scale_range: float
    """Logarithm of the ratio of the largest to the smallest scale."""
    across: float
    """Bias of the raw scales of the first two axes."""
    thickness: float
    """Bias of the raw scale of the third axis."""
    opacity_floor: float
    opacity_bias: float
    color_limit: float
    """Largest change of a colour from its pixel's."""


def footprint_attributes(
    offset: Float[Tensor, "N 3"],
    scale: Float[Tensor, "N 3"],
    rotation: Float[Tensor, "N 4"],
    opacity: Float[Tensor, " N"],
    footprint: Float[Tensor, " N"],
    constants: Constants,
) -> Attributes:
    """Offsets, scales, quaternions and opacities in units of a pixel's footprint.

    Args:
        offset: raw, as are the next three.
        scale: raw.
        rotation: raw; 0 is no rotation.
        opacity: raw.
        footprint: side of a pixel at each Gaussian's depth, in metres.
        constants: of ``FootprintAttributes``.

    Returns:
        Offsets and scales in metres, unit quaternions, and opacities from ``opacity_floor`` to 1.
    """
    limit, metres, inward, floor, span, across, thickness, least, bias, _ = constants
    identity = F.pad(rotation.new_ones(1), (0, 3))
    scale = torch.cat((scale[:, :2] + across, scale[:, 2:] + thickness), 1)
    scale = floor * torch.exp(span * bounded_sigmoid(scale))
    shown = bounded_sigmoid(opacity + bias)
    moved = limit * bounded_tanh(offset) if limit > 0 else metres * offset
    return (
        moved + F.pad(inward * footprint[:, None], (2, 0)),
        footprint[:, None] * scale,
        unit(identity + rotation, SHORTEST),
        least + (1 - least) * shown,
    )


def activated(
    raw: tuple[Tensor, Tensor, Tensor, Tensor, Tensor | None],
    image: Int[Tensor, " N"],
    pixel: Int[Tensor, " N"],
    maps: DepthMaps,
    points: Float[Tensor, "B V H W 3"],
    photo: Float[Tensor, "B V 3 H W"],
    share: Float[Tensor, "B V H W"] | None,
    cameras: Cameras,
    attributes: Callable[[Tensor, Tensor, Tensor, Tensor, Tensor], Attributes],
    color_limit: float,
    on_surface: bool,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Gaussians from raw attributes.

    Args:
        raw: offsets, scales, rotations, opacities and colours (or None) before activations.
        image: numbers of the images (``b * V + v``) that the Gaussians belong to.
        pixel: row-major indices of their pixels.
        maps: depths in metres.
        points: world points of pixels, in metres.
        photo: colours of pixels, in [0, 1].
        share: factors of opacities; None: 1.
        cameras: of the images.
        attributes: offsets, scales, quaternions and opacities of raw ones and of footprints.
        color_limit: largest change of a colour from its pixel's.
        on_surface: ``raw`` is in axes of the surface.

    Returns:
        Means in metres [N, 3], quaternions [N, 4], scales in metres [N, 3],
        opacities [N] and colours [N, 3].
    """
    *numbers, color = raw
    focal = focal_lengths(cameras).prod(-1).sqrt().flatten()[image]
    depth = maps.depth.flatten(0, 1).flatten(1)[image, pixel]
    # No gradient: a splat that is too large must not move nearer to become smaller.
    footprint = depth.detach() / focal
    offset, scales, quaternions, opacities = attributes(*numbers, footprint)
    if on_surface:
        axes = surface_axes(maps, cameras, image, pixel)
        offset = rotate(axes, offset)
        quaternions = multiply_quaternions(axes, quaternions)
    if share is not None:
        opacities = opacities * share.to(opacities).flatten(0, 1).flatten(1)[image, pixel]
    colors = photo.flatten(0, 1).flatten(2).transpose(1, 2)[image, pixel]
    if color is not None:
        colors = colors + color_limit * bounded_tanh(color)
    means = points.flatten(0, 1).flatten(1, 2)[image, pixel] + offset
    return means, quaternions, scales, opacities, colors


def footprint_gaussians(
    raw: tuple[Tensor, Tensor, Tensor, Tensor, Tensor | None],
    image: Int[Tensor, " N"],
    pixel: Int[Tensor, " N"],
    maps: DepthMaps,
    points: Float[Tensor, "B V H W 3"],
    photo: Float[Tensor, "B V 3 H W"],
    share: Float[Tensor, "B V H W"] | None,
    cameras: Cameras,
    constants: Constants,
    on_surface: bool,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """:func:`activated` with :func:`footprint_attributes`, which kernels compute, too.

    Args:
        raw: as of :func:`activated`, as are all but ``constants``.
        image: numbers of the images (``b * V + v``) that the Gaussians belong to.
        pixel: row-major indices of their pixels.
        maps: depths in metres.
        points: world points of pixels, in metres.
        photo: colours of pixels, in [0, 1].
        share: factors of opacities; None: 1.
        cameras: of the images.
        constants: of ``FootprintAttributes``, with the limit of colours.
        on_surface: ``raw`` is in axes of the surface.

    Returns:
        As of :func:`activated`.
    """
    attributes = partial(footprint_attributes, constants=constants)
    given = (raw, image, pixel, maps, points, photo, share, cameras)
    return activated(*given, attributes, constants.color_limit, on_surface)
