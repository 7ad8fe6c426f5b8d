"""Near and far of each pixel from the visual hull of the other views.

Rays of the subject's pixels are marched through the subject's box, and depths that the masks of the
*other* views allow are kept: the image-based visual hull (Matusik et al., 2000). Nothing here has a
gradient."""

import torch
from jaxtyping import Bool, Int
from pydantic import Field
from torch import Tensor

from ghgs_lit.extents import bucket_size
from ghgs_lit.geometry.constants import constant, middles
from ghgs_lit.method.bounds.box import SubjectBox
from ghgs_lit.method.bounds.rays import (
    Silhouettes,
    cut_sides,
    depths_in_box,
    dilate,
    projection_matrices,
    ray_directions,
    votes_outside,
)
from ghgs_lit.ops.ray_marching import march
from ghgs_lit.types import Batch, Cameras, DepthBounds


class VisualHull(SubjectBox):
    """``bounds(batch) -> DepthBounds``: depths at which each ray of the subject enters and leaves the
    visual hull. Other pixels, and rays that miss the hull, get the bounds of the box."""

    samples: int = Field(48, ge=2, le=4096)
    """Number of depths that are tested along each ray"""

    def _within(
        self, batch: Batch, coarse: Silhouettes, voting: Tensor, lower: Tensor, upper: Tensor
    ) -> DepthBounds:
        """As in :class:`SubjectBox`, but within the hull for the subject's pixels; rays are marched at the
        resolution of ``coarse``."""
        box = self._make_valid(depths_in_box(batch.cameras, lower, upper))
        start = box if coarse.stride == 1 else self._make_valid(depths_in_box(coarse.cameras, lower, upper))
        # At least one cell: the rays of a cell's pixels differ from the ray of its centre.
        radius = max(coarse.dilation, 1)
        rays = batch.pixels if coarse.stride == 1 else None
        count = bucket_size(sum(extent.cells(coarse.stride) for extent in batch.extents))
        seen = (coarse.masks, coarse.cameras, start, radius)
        hull = hull_bounds(*seen, self.tolerance, self.samples, rays, voting, count, coarse.cut)
        near, far = (_enlarge(x, coarse.stride, batch.masks.shape[-2:]) for x in (hull.near, hull.far))
        return self._make_valid(DepthBounds(torch.maximum(box.near, near), torch.minimum(box.far, far)))


def hull_bounds(
    masks: Bool[Tensor, "B V h w"],
    cameras: Cameras,
    start: DepthBounds,
    radius: int,
    tolerance: int = 0,
    samples: int = 48,
    rays: Int[Tensor, " r"] | None = None,
    voting: Bool[Tensor, "B V"] | None = None,
    count: int | None = None,
    cut: Bool[Tensor, "B V 4"] | None = None,
) -> DepthBounds:
    """First and last depths within ``start`` that the dilated masks of the other views allow.

    Pixels outside the subject, and rays that miss the hull, keep the bounds of ``start``.

    Args:
        masks: the subject's pixels, whose rays are marched.
        cameras: [B, V], whose pixels are those of the masks.
        start: bounds [B, V, h, w] in metres, between which depths are tested.
        radius: dilation of the masks in pixels.
        tolerance: number of other views in which an allowed depth may lie outside the mask.
        samples: number of depths that are tested along each ray.
        rays: indices of the masks' pixels, if known.
        voting: views whose masks are used; None: those whose mask is not empty.
        count: upper limit of the number of the masks' pixels, which avoids a device-to-host
            synchronisation; None: unknown.
        cut: sides of the frame that cut the subject; None: those that the masks touch.

    Returns:
        Bounds [B, V, h, w] in metres, half a step outside the first and last allowed depths.
    """
    voting = masks.flatten(2).any(-1) if voting is None else voting
    cut = cut_sides(masks) if cut is None else cut
    outside = votes_outside(dilate(masks, radius), voting, cut)
    directions = ray_directions(cameras)
    matrices = projection_matrices(cameras)
    steps = constant(middles, samples, like=start.near)
    bounds = (start.near, start.far)
    near, far = march(
        masks, outside, matrices, directions, cameras.centers, *bounds, steps, tolerance, rays, count
    )
    return DepthBounds(near, far)


def _enlarge(values: Tensor, stride: int, size: tuple[int, int]) -> Tensor:
    """Repeat values of cells for their ``stride`` x ``stride`` pixels; crop to ``size`` (height, width)."""
    values = values.repeat_interleave(stride, -2).repeat_interleave(stride, -1)
    return values[..., : size[0], : size[1]]
