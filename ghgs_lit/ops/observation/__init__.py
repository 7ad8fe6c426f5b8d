"""Comparison of Gaussians with input views and renders at their projected positions."""

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from ghgs_lit.geometry.constants import constant
from ghgs_lit.geometry.projection import project
from ghgs_lit.ops.dispatch import Operator, everything
from ghgs_lit.types import Cameras

#: Values of a Gaussian in a view: image minus the Gaussian's colour (3), image minus render (3), mask,
#: alpha, distance behind the rendered surface, whether the Gaussian is visible in the view, whether
#: the view is its own.
CHANNELS = 11


def _observe(
    means: Float[Tensor, "N 3"],
    colors: Float[Tensor, "N 3"],
    image: Int[Tensor, " N"],
    intrinsics: Float[Tensor, "B V 3 3"],
    extrinsics: Float[Tensor, "B V 4 4"],
    photo: Float[Tensor, "B V 3 H W"],
    mask: Float[Tensor, "B V H W"],
    drawn: Float[Tensor, "B V 3 H W"],
    alpha: Float[Tensor, "B V 1 H W"],
    depth: Float[Tensor, "B V 1 H W"],
    scale: float,
    splits: Sequence[int],
) -> Float[Tensor, "N V c"]:
    """Compute the values of each Gaussian in each view, its own view first, in plain PyTorch.

    Args:
        means: means of the Gaussians, in metres.
        colors: colours of the Gaussians.
        image: index of each Gaussian's image (``b * V + v``), ascending.
        intrinsics: intrinsics of the views, in pixels.
        extrinsics: world-to-camera matrices of the views.
        photo: input views.
        mask: coverage of each pixel by the subject.
        drawn: rendered colours.
        alpha: rendered opacities.
        depth: rendered depths in metres.
        scale: scale of the distance behind the rendered surface, in metres.
        splits: number of Gaussians of each element.
    """
    views = photo.shape[1]
    cameras = Cameras(intrinsics, extrinsics, *photo.shape[-2:])
    maps = torch.cat((photo, photo - drawn, mask[:, :, None], alpha, depth), 2)
    seen, z, can_see = values_at(means, image, splits, cameras, maps)
    color, error, mask, alpha, depth = seen.split((3, 3, 1, 1, 1), -1)
    behind = torch.tanh((z - depth) / scale)
    values = torch.cat((color - colors[:, None], error, mask, alpha, behind), -1)
    values = torch.cat((torch.where(can_see, values, 0), can_see.to(values)), -1)
    own_first = constant(_cyclic, views, like=values, dtype=torch.long)[image % views]
    values = values.gather(1, own_first[..., None].expand_as(values))
    is_own = constant(torch.eye, views, like=values)[0].expand(len(values), -1)
    return torch.cat((values, is_own[..., None]), -1)


observations = Operator(
    "observe(Tensor means, Tensor colors, Tensor image, Tensor intrinsics, Tensor extrinsics, Tensor photo, "
    "Tensor mask, Tensor drawn, Tensor alpha, Tensor depth, float scale, int[] splits) -> Tensor",
    _observe,
    __name__,
    {"cpu": everything, "cuda": everything},
)


def _cyclic(views: int, **kind: object) -> Tensor:
    """For each view, all views in cyclic order from it on, [V, V]."""
    view = torch.arange(views, **kind)
    return (view[:, None] + view) % views


def values_at(
    means: Tensor, image: Tensor, splits: Sequence[int], cameras: Cameras, maps: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Sample maps bilinearly at projected means; 0 outside the maps.

    Args:
        means: in the world [N, 3].
        image: index of each mean's image (``b * V + v``), ascending [N].
        splits: number of means of each element.
        cameras: cameras of the maps, [B, V].
        maps: [B, V, c, H, W].

    Returns:
        Values in each view [N, V, c], z-depths [N, V, 1], and whether the means are in front of the
        camera and inside the frame [N, V, 1].
    """
    b, views, channels, height, width = maps.shape
    rows = None
    means = means[None]
    if b > 1:
        # One row of points per element, padded with points at 0.
        rows = _rows(image // views, splits)
        means = means.new_zeros(b, max(splits), 3).index_put(rows, means[0])
    means = means[:, None].expand(-1, views, -1, -1)
    pixels, z = project(means, cameras.intrinsics[:, :, None], cameras.extrinsics[:, :, None])
    size = constant(torch.tensor, (width, height), like=pixels)
    # Clamp pixels far outside: large numbers are inexact.
    grid = (2 / size * pixels - 1).clamp(-3, 3).flatten(0, 1)[:, None]
    sampled = F.grid_sample(maps.flatten(0, 1), grid, align_corners=False)[:, :, 0]
    can_see = (z > 0) & ((pixels >= 0) & (pixels <= size)).all(-1)
    of_image = sampled.view(b, views, channels, -1).permute(0, 3, 1, 2)
    each = (of_image, z.mT[..., None], can_see.mT[..., None])
    return tuple(values[0] if rows is None else values[rows] for values in each)


def _rows(element: Int[Tensor, " N"], splits: Sequence[int]) -> tuple[Tensor, Tensor]:
    """The element of each Gaussian, ascending, and its index within the element."""
    first = torch.searchsorted(element, constant(torch.arange, len(splits), like=element))
    return element, torch.arange(len(element), device=element.device) - first[element]
