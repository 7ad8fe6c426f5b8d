"""The Gaussian head for GPUs: activations are one kernel, their gradients another."""

from collections.abc import Sequence

import torch
from torch import Tensor

from ghgs_lit.kernels import gpu
from ghgs_lit.method.heads.activations import Constants, footprint_gaussians
from ghgs_lit.types import Cameras, DepthMaps

_INPUTS = (
    "Tensor offset, Tensor scale, Tensor rotation, Tensor opacity, Tensor? color, Tensor image, "
    "Tensor pixel, Tensor depth, Tensor valid, Tensor points, Tensor photo, Tensor? share, "
    "Tensor intrinsics, Tensor extrinsics, float[] constants, bool on_surface"
)
#: Places of the inputs that have a gradient.
_RAW = (0, 1, 2, 3, 4)
_POINTS = 9


def is_supported(*tensors: Tensor | None, fixed: Sequence[Tensor | None]) -> bool:
    """Whether the kernels compute with these tensors.

    Args:
        tensors: all inputs; None: one that is left out.
        fixed: those that may not need a gradient.
    """
    is_needed = torch.is_grad_enabled() and any(x is not None and x.requires_grad for x in fixed)
    return not is_needed and gpu.is_supported(*tensors)


def _plain(*inputs) -> tuple[Tensor, ...]:
    """:func:`activate` in plain PyTorch; inputs in the order of ``_INPUTS``."""
    *raw, image, pixel, depth, valid, points, photo, share = inputs[:12]
    intrinsics, extrinsics, constants, on_surface = inputs[12:]
    maps = DepthMaps(depth, valid, depth)
    cameras = Cameras(intrinsics, extrinsics, *depth.shape[-2:])
    given = (tuple(raw), image, pixel, maps, points, photo, share, cameras)
    return footprint_gaussians(*given, Constants(*constants), on_surface)


def _plain_back(*inputs) -> list[Tensor]:
    """Gradients of raw values and points in plain PyTorch.

    Inputs are those of :func:`_plain` and gradients of its results.
    """
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


_activate = gpu.operator(f"activate({_INPUTS}) -> ({', '.join(['Tensor'] * 5)})", _plain, __name__)
_activate_back = gpu.operator(f"activate_back({_INPUTS}, Tensor[] slopes) -> Tensor[]", _plain_back, __name__)


class _Activate(torch.autograd.Function):
    @staticmethod
    def forward(ctx, *inputs):
        *tensors, ctx.constants, ctx.on_surface = inputs
        ctx.save_for_backward(*tensors)
        outputs = _activate(*inputs)
        if tensors[4] is None:  # colours are those of the photographs
            ctx.mark_non_differentiable(outputs[4])
        return outputs

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, *slopes):
        inputs = ctx.saved_tensors
        *of_raw, of_points = _activate_back(*inputs, ctx.constants, ctx.on_surface, slopes)
        gradients = [None] * (len(inputs) + 2)
        gradients[: len(of_raw)] = of_raw
        gradients[_POINTS] = of_points
        if inputs[4] is None:
            gradients[4] = None
        return tuple(gradients)


def activate(
    raw: tuple[Tensor, Tensor, Tensor, Tensor, Tensor | None],
    image: Tensor,
    pixel: Tensor,
    maps: DepthMaps,
    points: Tensor,
    photo: Tensor,
    share: Tensor | None,
    cameras: Cameras,
    constants: Constants,
    on_surface: bool,
) -> tuple[Tensor, ...]:
    """:func:`ghgs_lit.method.heads.activations.footprint_gaussians`,
    differentiable in ``raw`` and ``points``.

    Args:
        raw: offsets, scales, rotations, opacities and colours (or None) before activations.
        image: [N], numbers of the images (``b * V + v``) that the Gaussians belong to.
        pixel: [N], row-major indices of their pixels.
        maps: depths in metres.
        points: [B, V, H, W, 3], world points of pixels, in metres.
        photo: [B, V, 3, H, W], colours of pixels, in [0, 1].
        share: [B, V, H, W], factors of opacities; None: 1.
        cameras: of the images.
        constants: of ``FootprintAttributes``, with the limit of colours.
        on_surface: ``raw`` is in axes of the surface.

    Returns:
        Means, quaternions, scales, opacities and colours.
    """
    seen = (image, pixel, maps.depth, maps.valid, points, photo, share)
    return _Activate.apply(*raw, *seen, cameras.intrinsics, cameras.extrinsics, list(constants), on_surface)
