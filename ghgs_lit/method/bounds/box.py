"""Near and far of each pixel from an axis-aligned box around the subject.

The box is found by carving a coarse grid with the masks, which are dilated because real masks are
noisy. Nothing here has a gradient."""

from typing import ClassVar

import torch
from jaxtyping import Bool, Float
from pydantic import Field
from torch import Tensor

from ghgs_lit.config.options import Index, Options
from ghgs_lit.geometry.constants import constant
from ghgs_lit.geometry.frame import in_cameras, subject_center
from ghgs_lit.geometry.masks import first_and_last
from ghgs_lit.geometry.precision import exact
from ghgs_lit.geometry.projection import focal_lengths, project
from ghgs_lit.method.bounds import agreement
from ghgs_lit.method.bounds.rays import (
    Silhouettes,
    cut_sides,
    depths_in_box,
    dilate,
    pixel_axes,
    projection_matrices,
    silhouettes,
    votes_outside,
)
from ghgs_lit.ops.ray_marching import NEAREST, look_up
from ghgs_lit.types import Batch, Cameras, DepthBounds

#: Largest number of cells along the longer side of the masks, and along each side of the carved grid.
RESOLUTION = 160
CELLS = 32

#: In metres: margin around the box, smallest near and smallest far - near.
MARGIN = 0.03
MIN_DEPTH = 0.1
MIN_THICKNESS = 0.02

#: Largest bound in metres, against overflow with cameras of implausible scale.
_FARTHEST = 1e6


class SubjectBox(Options):
    """``bounds(batch) -> DepthBounds``: depths at which each ray enters and leaves the subject's box.

    A ray that misses the box gets the range of depths of the whole box. Views with an empty mask do
    not vote, nor does one whose mask contradicts all others
    (:func:`ghgs_lit.method.bounds.agreement.trusted_views`)."""

    group = "bounds"
    dilation: float = Field(0.01, ge=0, lt=0.5)
    """Dilation of the masks, a fraction of the image's longer side; 0.02 to 0.03 for noisy masks"""
    tolerance: Index = 0
    """Number of views in which a point of the subject may lie outside the mask"""

    @property
    def is_bounded(self) -> bool:
        """True: every stage except :class:`NoBounds` gives bounds."""
        return True

    @torch.no_grad()
    def __call__(self, batch: Batch) -> DepthBounds:
        """Compute bounds of all pixels, without a gradient.

        Args:
            batch: masks and cameras are read; images may have any size.

        Returns:
            Near and far [B, V, H, W] in metres: near is at least :data:`MIN_DEPTH`, far at least
            :data:`MIN_THICKNESS` behind it.
        """
        with exact(batch.masks.device.type):
            coarse = silhouettes(batch.masks, batch.cameras, RESOLUTION, self.dilation)
            voting = self._select_voting(coarse)
            lower, upper = subject_box(
                coarse.masks & voting[..., None, None],
                coarse.cameras,
                coarse.dilation,
                self.tolerance,
                coarse.cut,
            )
            return self._within(batch, coarse, voting, lower - MARGIN, upper + MARGIN)

    def _select_voting(self, coarse: Silhouettes) -> Bool[Tensor, "B V"]:
        """Select the views that vote about the box, using even coarser masks."""
        few = silhouettes(coarse.masks, coarse.cameras, agreement.RESOLUTION, self.dilation, coarse.cut)
        center = subject_center(few.masks, few.cameras)
        # The median, not the largest: with a mask of noise no sample would lie within the subject.
        reach = _reach(few.masks, few.cameras, center).nanmedian(1).values
        return agreement.trusted_views(few, center, reach, self.tolerance)

    def _within(
        self, batch: Batch, coarse: Silhouettes, voting: Tensor, lower: Tensor, upper: Tensor
    ) -> DepthBounds:
        """Compute bounds of all pixels within the subject's box, from corner ``lower`` to ``upper`` [B, 3]
        in metres; ``coarse`` are the masks at a lower resolution, ``voting`` the views to use."""
        return self._make_valid(depths_in_box(batch.cameras, lower, upper))

    def _make_valid(self, bounds: DepthBounds) -> DepthBounds:
        """Clamp bounds in front of the camera, and move them apart where they are too close."""
        near, far = (x.nan_to_num(nan=0.0).clamp(max=_FARTHEST) for x in (bounds.near, bounds.far))
        missing = (MIN_THICKNESS - (far - near)).clamp(min=0) / 2
        near = (near - missing).clamp(min=MIN_DEPTH)
        return DepthBounds(near, torch.maximum(far + missing, near + MIN_THICKNESS))


def subject_box(
    masks: Bool[Tensor, "B V h w"],
    cameras: Cameras,
    radius: int,
    tolerance: int = 0,
    cut: Bool[Tensor, "B V 4"] | None = None,
) -> tuple[Float[Tensor, "B 3"], Float[Tensor, "B 3"]]:
    """Axis-aligned bounding box of the visual hull.

    Carved in two passes: the second grid fills the box of the first. If nothing remains
    (contradicting masks), the box before that pass is kept.

    Args:
        masks: the subject's pixels; a view with an empty mask does not vote.
        cameras: [B, V], whose pixels are those of the masks.
        radius: dilation of the masks in pixels.
        tolerance: number of views in which a kept point may lie outside the mask.
        cut: sides of the frame that cut the subject; None: those that the masks touch.

    Returns:
        The corners with the smallest and with the largest coordinates, in metres.
    """
    center = subject_center(masks, cameras)
    reach = _reach(masks, cameras, center).nan_to_num().amax(1, keepdim=True).clamp(min=0.05)
    corners = torch.stack((center - reach, center + reach))
    focal = focal_lengths(cameras).amax(-1)
    voting = masks.flatten(2).any(-1)
    cut = cut_sides(masks) if cut is None else cut
    for _ in range(2):
        lower, upper = corners
        cell = (upper - lower) / CELLS
        depth = in_cameras((lower + upper) / 2, cameras.extrinsics)[..., 2]
        # Half a cell's diagonal in pixels, for points as near as 0.6 times the depth of the box's centre.
        pixels = focal * cell.norm(dim=-1, keepdim=True) / 2 / (0.6 * depth).clamp(min=NEAREST)
        grow = pixels.nan_to_num(nan=0.0).amax(1).clamp(max=max(masks.shape[-2:])).ceil().int()
        grown = dilate(masks, radius, grow)
        kept = _carve(votes_outside(grown, voting, cut), cameras, lower, cell, tolerance)
        # Slices with a kept cell, for each axis.
        slices = torch.stack([kept.any(axes) for axes in ((2, 3), (1, 3), (1, 2))], 1)
        first, last = first_and_last(slices)
        ends = torch.stack((first, last + 1))
        corners = torch.where(slices[:, 0].any(-1)[:, None], lower + ends * cell, corners)
    return corners[0], corners[1]


def _carve(
    outside: Tensor, cameras: Cameras, lower: Tensor, cell: Tensor, tolerance: int
) -> Bool[Tensor, "B n n n"]:
    """Cells of a grid that at most ``tolerance`` views vote out; the grid starts at ``lower`` [B, 3] with
    cells of size ``cell`` [B, 3], in metres."""
    steps = constant(torch.arange, CELLS, like=lower) + 0.5
    position = lower[..., None] + cell[..., None] * steps
    matrices = projection_matrices(cameras)
    columns = matrices.movedim(2, 0)[..., None]
    x, y, z = (columns[..., :3, :] * position[:, None]).unbind(3)
    z = z + columns[..., 3, :]
    pixels = (x[..., :, None] + y[..., None, :])[..., None] + z[..., None, None, :]
    count = outside.shape[0] * outside.shape[1]
    image = constant(torch.arange, count, like=outside, dtype=torch.long).view(*outside.shape[:2], 1, 1, 1)
    return look_up(outside.flatten(0, 1), image, pixels).sum(1) <= tolerance


def _reach(masks: Bool[Tensor, "B V h w"], cameras: Cameras, center: Float[Tensor, "B 3"]) -> Tensor:
    """Generous radius [B, V] in metres of the subject about ``center``, estimated from each view; NaN for
    an empty mask."""
    pixel, depth = project(center[:, None].expand(*cameras.shape, 3), cameras.intrinsics, cameras.extrinsics)
    extents = [
        torch.where(masks.any(-2 + dim), (line - pixel[..., dim, None]).abs() + 0.5, 0).amax(-1)
        for dim, line in enumerate(pixel_axes(cameras))
    ]
    extent = torch.stack(extents, -1) / focal_lengths(cameras)
    # 1.4: limbs along the viewing direction look shorter than they are.
    reach = 1.4 * extent.norm(dim=-1) * depth.clamp(min=NEAREST)
    return torch.where(masks.flatten(2).any(-1), reach, torch.nan)


class NoBounds(Options):
    """Bounds stage of a model without bounds, as in the authors' release."""

    group = "bounds"
    is_bounded: ClassVar[bool] = False

    def __call__(self, batch: Batch) -> None:
        """Return None."""
        return None
