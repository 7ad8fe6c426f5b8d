"""Rays of pixels, and silhouettes: masks that are dilated and sampled at projected points.

A ray is a function of depth z: ``point(z) = center + z * direction``."""

from dataclasses import dataclass
from itertools import product
from math import ceil

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from ghgs_lit.geometry.constants import constant
from ghgs_lit.geometry.projection import (
    at_least_float32,
    homogeneous_centers,
    inverse_intrinsics,
    pixel_centers,
    world_to_camera,
)
from ghgs_lit.types import Cameras, DepthBounds


def ray_directions(cameras: Cameras) -> Float[Tensor, "*batch h w 3"]:
    """Direction of each pixel's ray: displacement in the world, in metres, per metre of depth z."""
    intrinsics = at_least_float32(cameras.intrinsics)
    extrinsics = at_least_float32(cameras.extrinsics)
    centers = homogeneous_centers(cameras.height, cameras.width, intrinsics)
    to_world = extrinsics[..., :3, :3].mT @ inverse_intrinsics(intrinsics)
    return torch.einsum("...ij,hwj->...hwi", to_world, centers)


def projection_matrices(cameras: Cameras) -> Float[Tensor, "*batch 3 4"]:
    """Matrices ``K [R t]``, which map homogeneous world points to homogeneous pixels."""
    return at_least_float32(cameras.intrinsics) @ at_least_float32(cameras.extrinsics)[..., :3, :]


def pixel_axes(cameras: Cameras) -> tuple[Float[Tensor, " w"], Float[Tensor, " h"]]:
    """Coordinates of pixel centres along a row (columns + 0.5) and along a column (rows + 0.5)."""
    centers = pixel_centers(cameras.height, cameras.width, at_least_float32(cameras.intrinsics))
    return centers[0, :, 0], centers[:, 0, 1]


def depths_in_box(cameras: Cameras, lower: Float[Tensor, "B 3"], upper: Float[Tensor, "B 3"]) -> DepthBounds:
    """Depths at which the ray of each pixel enters and leaves an axis-aligned box, by the slab method
    (Kay and Kajiya, SIGGRAPH 1986).

    Args:
        cameras: [B, V].
        lower: corner of the box with the smallest coordinates, in metres.
        upper: corner with the largest coordinates.

    Returns:
        Bounds [B, V, h, w] in metres, possibly behind the camera; for a ray that misses the box, the
        range of depths of the whole box.
    """
    directions = ray_directions(cameras)
    centers = cameras.centers[:, :, None, None]
    # For rays parallel to a face: 1e-12 instead of 0 gives the right infinities without 0 / 0.
    directions = torch.where(directions.abs() < 1e-12, 1e-12, directions)
    faces = [(face[:, None, None, None] - centers) / directions for face in (lower, upper)]
    near = torch.minimum(*faces).amax(-1)
    far = torch.maximum(*faces).amin(-1)
    is_upper = constant(torch.tensor, _CORNERS, like=lower, dtype=torch.bool)
    corners = torch.where(is_upper, upper[:, None], lower[:, None])
    corners = corners[:, None].expand(-1, cameras.shape[1], -1, -1)
    depth = world_to_camera(corners, cameras.extrinsics[:, :, None])[..., 2]
    misses = near >= far
    return DepthBounds(
        torch.where(misses, depth.amin(-1)[..., None, None], near),
        torch.where(misses, depth.amax(-1)[..., None, None], far),
    )


#: Which faces meet in each corner of a box.
_CORNERS = tuple(product((False, True), repeat=3))


@dataclass(frozen=True)
class Silhouettes:
    """Masks at a lower resolution.

    Attributes:
        masks: masks of cells.
        cameras: cameras whose pixels are the cells.
        stride: side of a cell in pixels.
        dilation: dilation of the masks, in cells.
        cut: sides of the frame that cut the subject, as in :func:`cut_sides`.
    """

    masks: Bool[Tensor, "B V h w"]
    cameras: Cameras
    stride: int
    dilation: int
    cut: Bool[Tensor, "B V 4"]


def cut_sides(masks: Bool[Tensor, "*batch h w"]) -> Bool[Tensor, "*batch 4"]:
    """Whether masks touch the first row, last row, first column and last column of their frames."""
    sides = [_ends(masks, axis).any(-3 - axis) for axis in (-2, -1)]
    return torch.cat([side.expand(*side.shape[:-1], 2) for side in sides], -1)


def _ends(values: Tensor, axis: int) -> Tensor:
    """View of the first and last line along an axis (-2 or -1), or of the only one.

    A slice, since a list of indices would be copied to a GPU."""
    places = slice(None, None, max(values.shape[axis] - 1, 1))
    return values[..., places, :] if axis == -2 else values[..., places]


def silhouettes(
    masks: Bool[Tensor, "B V H W"],
    cameras: Cameras,
    resolution: int,
    dilation: float,
    cut: Bool[Tensor, "B V 4"] | None = None,
) -> Silhouettes:
    """Downsample masks, to limit the cost of a search; a cell is True if any of its pixels is.

    Args:
        masks: the subject's pixels.
        cameras: [B, V], of the masks.
        resolution: largest number of cells along the image's longer side.
        dilation: fraction of the image's longer side; converted to cells, rounded up.
        cut: sides of the frame that cut the subject; None: those that the masks touch.
    """
    cut = cut_sides(masks) if cut is None else cut
    stride = ceil(max(masks.shape[-2:]) / resolution)
    if stride > 1:
        masks = F.max_pool2d(masks.float(), stride, stride, ceil_mode=True).bool()
    height, width = masks.shape[-2:]
    # Whole cells: the last row and column may extend beyond the image.
    matrices = map(at_least_float32, (cameras.intrinsics, cameras.extrinsics))
    full = Cameras(*matrices, height * stride, width * stride)
    return Silhouettes(masks, full.resize(height, width), stride, ceil(dilation * max(height, width)), cut)


def dilate(
    masks: Bool[Tensor, "*batch h w"], radius: int, more: Int[Tensor, " b"] | None = None
) -> Bool[Tensor, "*batch h w"]:
    """Dilate masks by squares.

    Args:
        masks: masks of b elements along the first dimension.
        radius: radius in pixels.
        more: additional radius of each element; None: 0.
    """
    return _dilate_axis(_dilate_axis(masks, radius, more, -2), radius, more, -1)


def _dilate_axis(masks: Tensor, radius: int, more: Tensor | None, axis: int) -> Tensor:
    """:func:`dilate` along one axis (-2 or -1), at a cost independent of the radius."""
    if more is not None:
        radius = radius + more.view(-1, *[1] * (masks.dim() - 1))
    size = masks.shape[axis]
    index = constant(torch.arange, size, like=masks, dtype=torch.long)
    index = index[:, None] if axis == -2 else index
    counts = F.pad(masks.cumsum(axis, dtype=torch.int32), (0, 0, 1, 0) if axis == -2 else (1, 0))
    high = (index + radius + 1).clamp(max=size)
    low = (index - radius).clamp(min=0)
    high, low = (counts.gather(axis, ends.long().expand(masks.shape)) for ends in (high, low))
    return high > low


def votes_outside(
    dilated: Bool[Tensor, "B V h w"], voting: Bool[Tensor, "B V"], cut: Bool[Tensor, "B V 4"]
) -> UInt8[Tensor, "B V h w"]:
    """Votes of pixels against the subject: 1 where a pixel of a voting view is outside it.

    Beyond a side of the frame that cuts the subject, nothing was observed. Points there are sampled
    at the nearest border pixel (:func:`look_up`), so the border of such a side is 0 everywhere.

    Args:
        dilated: masks, dilated because real ones are noisy.
        voting: views that vote; others are 0.
        cut: sides that cut the subject, as in :func:`cut_sides`.
    """
    outside = dilated < voting[..., None, None]
    whole = ~cut
    for axis, sides in ((-2, whole[..., :2]), (-1, whole[..., 2:])):
        ends = _ends(outside, axis)
        known = sides if ends.shape[axis] == 2 else sides.all(-1, keepdim=True)
        ends &= known.unsqueeze(-3 - axis)
    return outside.view(torch.uint8)
