"""Activations of the raw output channels of heads, surface axes, and the Gaussians made from both."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor
from torch.library import register_autograd

from ghgs_lit.geometry.projection import at_least_float32, focal_lengths
from ghgs_lit.geometry.rotations import matrix_to_quaternion, multiply_quaternions, rotate, unit
from ghgs_lit.ops.dispatch import LIBRARY, Operator, everything, without_gradients
from ghgs_lit.types import Cameras, DepthMaps


class _Saturate(torch.autograd.Function):
    """A sigmoid or tanh whose argument is clamped; see :func:`bounded_sigmoid`."""

    @staticmethod
    def forward(ctx, x: Tensor, limit: float, symmetric: bool) -> Tensor:
        """Apply the activation to ``x`` clamped to +-``limit``; ``symmetric`` selects tanh."""
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


#: Largest arguments of the activations, at which sigmoid and tanh have slopes of 4.5e-5 and 1.8e-4.
SIGMOID_LIMIT = 10.0
TANH_LIMIT = 5.0
EXP_LIMIT = 80.0


def bounded_sigmoid(x: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """Sigmoid of ``x`` clamped to +-10; beyond, only gradients that lead back into the limits remain.

    In float32 a plain sigmoid is exactly 1 from 17 on and has no gradient, so that one step that is
    too large would end the training of a head.
    """
    return _Saturate.apply(x, SIGMOID_LIMIT, False)


def bounded_tanh(x: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """Hyperbolic tangent of ``x`` clamped to +-5, with gradients as in :func:`bounded_sigmoid`."""
    return _Saturate.apply(x, TANH_LIMIT, True)


def confidence_of(raw: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """Confidence ``1 + exp(raw)``, as in VGGT's heads; finite for any raw value but NaN."""
    return 1 + raw.clamp(max=EXP_LIMIT).exp()


#: Shorter quaternions get the gradient of this length: it would grow without bound near 0.
SHORTEST = 0.1

Attributes = tuple[Tensor, Tensor, Tensor, Tensor]


class Constants(NamedTuple):
    """Constants of :func:`footprint_attributes`; lengths are in footprints, those of offsets in metres."""

    offset_limit: float
    """Largest offset along each axis in metres; 0: no limit."""
    offset_unit: float
    """Offset in metres for a raw value of 1 if there is no limit."""
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
    """Largest difference of a colour from the colour of its pixel."""


def footprint_attributes(
    offset: Float[Tensor, "N 3"],
    scale: Float[Tensor, "N 3"],
    rotation: Float[Tensor, "N 4"],
    opacity: Float[Tensor, " N"],
    footprint: Float[Tensor, " N"],
    constants: Constants,
) -> Attributes:
    """Activate offsets, scales, rotations and opacities, with scales relative to a pixel's footprint.

    Args:
        offset: raw values.
        scale: raw values.
        rotation: raw values; 0 is no rotation.
        opacity: raw values.
        footprint: side of a pixel at the depth of each Gaussian, in metres.
        constants: constants of ``FootprintAttributes``.

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


#: A neighbour has weight 1 if its depth differs by less than ``SAME`` pixel footprints, and weight 0
#: (another surface) from ``OTHER`` on.
SAME = 4.0
OTHER = 8.0


@torch.no_grad()
def surface_axes(
    maps: DepthMaps, cameras: Cameras, image: Int[Tensor, " N"], pixel: Int[Tensor, " N"]
) -> Float[Tensor, "N 4"]:
    """Unit quaternions from surface axes to the world, without a gradient.

    The third axis is the normal that points away from the camera; the others are the camera's right
    and down axes, turned by the smallest rotation from its forward axis to the normal. Normals come
    from depth differences to neighbouring valid pixels of the same surface; along an image axis
    without such neighbours the slope is 0.

    Args:
        maps: depths in metres with their validity.
        cameras: cameras of the maps, [B, V].
        image: index of each Gaussian's image (``b * V + v``).
        pixel: row-major index of its pixel.
    """
    height, width = maps.depth.shape[-2:]
    depth = at_least_float32(maps.depth)
    own = depth.flatten(0, 1).flatten(1)[image, pixel]
    intrinsics = at_least_float32(cameras.intrinsics).flatten(0, 1)[image]
    fx, skew, cx, fy, cy = (intrinsics[:, i, j] for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2)))
    row = pixel // width
    column = pixel % width
    # Invalid pixels and pixels outside the image are infinitely far away.
    around = F.pad(depth.masked_fill(~maps.valid, torch.inf), (1, 1, 1, 1), value=torch.inf).flatten()
    place = (image * (height + 2) + row + 1) * (width + 2) + column + 1
    # Depth difference and weight in [0, 1] of the neighbours to the right, below, to the left and above.
    deeper = around[torch.stack([place + step for step in (1, width + 2, -1, -width - 2)])] - own
    near = ((OTHER - deeper.abs() / (own / fx)) / (OTHER - SAME)).clamp(0, 1)
    after, before = (near * torch.where(near > 0, deeper, 0)).split(2)
    # Relative changes of depth from one pixel to the next.
    right, down = (after - before) / ((1 + near[:2] * near[2:]) * own + after + before)
    # The cross product of the tangents d(z K^-1 [u v 1]) / du and / dv, multiplied by fx fy / z^2.
    toward = 1 + right * (column + 0.5 - cx) + down * (row + 0.5 - cy)
    x = -fx * right
    y = -skew * right - fy * down
    length = (x.square() + y.square() + toward.square()).sqrt()
    turn = unit(torch.stack((length + toward, -y, x, torch.zeros_like(x)), -1))
    extrinsics = at_least_float32(cameras.extrinsics).flatten(0, 1)
    return multiply_quaternions(matrix_to_quaternion(extrinsics[:, :3, :3].mT)[image], turn)


def make_gaussians(
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
    """Make Gaussians from raw attributes.

    Args:
        raw: offsets, scales, rotations, opacities and colours (or None) before activation.
        image: index of each Gaussian's image (``b * V + v``).
        pixel: row-major index of its pixel.
        maps: depths in metres.
        points: world points of pixels, in metres.
        photo: colours of pixels, in [0, 1].
        share: factors of the opacities; None: 1.
        cameras: cameras of the images.
        attributes: maps raw offsets, scales, rotations, opacities and the footprints in metres to
            offsets, scales, quaternions and opacities.
        color_limit: largest difference of a colour from the colour of its pixel.
        on_surface: ``raw`` refers to surface axes (:func:`surface_axes`).

    Returns:
        Means in metres [N, 3], quaternions [N, 4], scales in metres [N, 3],
        opacities [N] and colours [N, 3].
    """
    *numbers, color = raw
    focal = focal_lengths(cameras).prod(-1).sqrt().flatten()[image]
    depth = maps.depth.flatten(0, 1).flatten(1)[image, pixel]
    # Detached: a splat that is too large must not move nearer to become smaller.
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
    """Make Gaussians from raw attributes with :func:`footprint_attributes`; see :func:`make_gaussians`.

    Differentiable with respect to all inputs but cameras and depths.

    Args:
        raw: offsets, scales, rotations, opacities and colours (or None) before activation.
        image: index of each Gaussian's image (``b * V + v``).
        pixel: row-major index of its pixel.
        maps: depths in metres.
        points: world points of pixels, in metres.
        photo: colours of pixels, in [0, 1].
        share: factors of the opacities; None: 1.
        cameras: cameras of the images.
        constants: constants of ``FootprintAttributes``, with the limit of colours.
        on_surface: ``raw`` refers to surface axes (:func:`surface_axes`).

    Returns:
        Means in metres [N, 3], quaternions [N, 4], scales in metres [N, 3],
        opacities [N] and colours [N, 3].
    """
    seen = (image, pixel, maps.depth, maps.valid, points, photo, share)
    return _activate(*raw, *seen, cameras.intrinsics, cameras.extrinsics, list(constants), on_surface)


_INPUTS = (
    "Tensor offset, Tensor scale, Tensor rotation, Tensor opacity, Tensor? color, Tensor image, "
    "Tensor pixel, Tensor depth, Tensor valid, Tensor points, Tensor photo, Tensor? share, "
    "Tensor intrinsics, Tensor extrinsics, float[] constants, bool on_surface"
)
#: Positions of the inputs that have a gradient, and of depths and extrinsics, whose gradient is 0.
_RAW = (0, 1, 2, 3, 4)
_POINTS = 9
_FIXED = (7, 13)


def _plain(*inputs: Any) -> tuple[Tensor, ...]:
    """:func:`footprint_gaussians` in plain PyTorch, with inputs in the order of ``_INPUTS``."""
    *raw, image, pixel, depth, valid, points, photo, share = inputs[:12]
    intrinsics, extrinsics, constants, on_surface = inputs[12:]
    maps = DepthMaps(depth, valid, depth)
    cameras = Cameras(intrinsics, extrinsics, *depth.shape[-2:])
    constants = Constants(*constants)
    attributes = partial(footprint_attributes, constants=constants)
    given = (raw, image, pixel, maps, points, photo, share, cameras)
    return make_gaussians(*given, attributes, constants.color_limit, on_surface)


def _plain_back(*inputs: Any) -> list[Tensor]:
    """Gradients of raw values and points in plain PyTorch, from the inputs of :func:`_plain` and the
    gradients of its results."""
    *inputs, slopes = inputs
    places = [place for place in (*_RAW, _POINTS) if inputs[place] is not None]
    for place in places:
        inputs[place] = inputs[place].detach().requires_grad_()
    with torch.enable_grad():
        pairs = zip(_plain(*inputs), slopes, strict=True)
        learned = [(output, slope) for output, slope in pairs if output.requires_grad]
        outputs, slopes = zip(*learned, strict=True)
        gradients = torch.autograd.grad(outputs, [inputs[place] for place in places], slopes)
    at_place = dict(zip(places, gradients, strict=True))
    return [at_place.get(place, inputs[0].new_empty(0)) for place in (*_RAW, _POINTS)]


_activate = Operator(
    f"activate({_INPUTS}) -> ({', '.join(['Tensor'] * 5)})",
    _plain,
    __name__,
    {"cpu": without_gradients, "cuda": everything},
    learned={"cuda": (*_RAW, _POINTS, *_FIXED)},
)
_activate_back = Operator(
    f"activate_back({_INPUTS}, Tensor[] slopes) -> Tensor[]", _plain_back, __name__, {"cuda": everything}
)


def _save(ctx: Any, inputs: tuple, output: tuple[Tensor, ...]) -> None:
    *tensors, ctx.constants, ctx.on_surface = inputs
    ctx.save_for_backward(*tensors)
    if tensors[4] is None:  # colours are copied from the images
        ctx.mark_non_differentiable(output[4])


@torch.autograd.function.once_differentiable
def _back(ctx: Any, *slopes: Tensor) -> tuple[Tensor | None, ...]:
    inputs = ctx.saved_tensors
    *of_raw, of_points = _activate_back(*inputs, ctx.constants, ctx.on_surface, slopes)
    gradients = [*of_raw, *[None] * (len(inputs) + 2 - len(of_raw))]
    gradients[_POINTS] = of_points
    if inputs[4] is None:
        gradients[4] = None
    return tuple(gradients)


register_autograd("ghgs_lit::activate", _back, setup_context=_save, lib=LIBRARY)
