"""Regions of an image that metrics are measured in, and means over them."""

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from ghgs_lit.errors import choice
from ghgs_lit.geometry.masks import between, first_and_last

REGIONS = ("image", "box", "subject", "crop", "edge")
CROP = (1000 / 1024, 500 / 1024)
"""Height and width of the region ``crop`` as shares of the image's: 1000 x 500 of 1024 x 1024, as
published scripts of GHG and LIFe-GoM crop."""
EDGE = 2
"""Greatest distance from the subject's outline in the region ``edge``, in rows and columns."""
DEPTH_STEP = 0.02
"""Least relative difference of the depths of neighbouring pixels at an edge of depth:
5 cm at 2.5 m."""


def mean_over(values: Float[Tensor, "n h w"], region: Bool[Tensor, "n h w"] | None) -> Float[Tensor, " n"]:
    """Mean of each map over its region.

    Args:
        values: maps of a metric.
        region: the pixels that count; None: all.

    Returns:
        A mean for each map; nan where the region is empty."""
    if region is None:
        return values.mean((-2, -1))
    count = region.sum((-2, -1))
    total = torch.where(region, values, torch.zeros_like(values)).sum((-2, -1))
    return torch.where(count > 0, total / count.clamp(min=1), torch.full_like(total, torch.nan))


def mean_inside(
    values: Float[Tensor, "n hh ww"], region: Bool[Tensor, "n h w"] | None
) -> Float[Tensor, " n"]:
    """:func:`mean_over` for maps that may lack the image's border.

    Args:
        values: maps, as large as the image or smaller by the same border on opposite sides.
        region: the pixels of the image that count, whose border is cut off, too; None: all.

    Returns:
        A mean for each map; nan where what is left of the region is empty."""
    if region is not None:
        top = (region.shape[1] - values.shape[1]) // 2
        left = (region.shape[2] - values.shape[2]) // 2
        region = region[:, top : top + values.shape[1], left : left + values.shape[2]]
    return mean_over(values, region)


def box_of(mask: Bool[Tensor, "n h w"]) -> Bool[Tensor, "n h w"]:
    """The bounding box of each mask, as a mask; empty where the mask is empty."""
    return between(mask.any(-1))[:, :, None] & between(mask.any(-2))[:, None, :]


def crop_of(mask: Bool[Tensor, "n h w"]) -> Bool[Tensor, "n h w"]:
    """A window of :data:`CROP` around the middle of each mask's box.

    Args:
        mask: of the subject.

    Returns:
        The window, moved into the image, as a mask; empty where the mask is empty."""

    def span(hit: Bool[Tensor, "n k"], share: float) -> Bool[Tensor, "n k"]:
        """Rows or columns of the window, from those that the mask hits."""
        count = hit.shape[1]
        side = round(share * count)
        index = torch.arange(count, device=hit.device)
        first, last = first_and_last(hit)
        start = (first - (side - (last - first + 1)) // 2).clamp(0, count - side)[:, None]
        return (index >= start) & (index < start + side) & hit.any(-1, keepdim=True)

    height, width = CROP
    return span(mask.any(-1), height)[:, :, None] & span(mask.any(-2), width)[:, None, :]


def grown(mask: Bool[Tensor, "n h w"], pixels: int) -> Bool[Tensor, "n h w"]:
    """Dilate masks.

    Args:
        mask: True where something is.
        pixels: largest distance in rows and in columns.

    Returns:
        Each mask with all pixels at most so far away."""
    return F.max_pool2d(mask[:, None].float(), 2 * pixels + 1, 1, pixels)[:, 0].bool()


def depth_edges(depth: Float[Tensor, "n h w"]) -> Bool[Tensor, "n h w"]:
    """Pixels on both sides of an edge of depth:
    next to a neighbour :data:`DEPTH_STEP` nearer or farther.

    Args:
        depth: z in metres; 0 is unknown, and no edge.

    Returns:
        A mask of each map."""
    edges = torch.zeros_like(depth, dtype=torch.bool)
    for axis in (1, 2):
        count = depth.shape[axis] - 1
        first = depth.narrow(axis, 0, count)
        second = depth.narrow(axis, 1, count)
        nearer = torch.minimum(first, second)
        is_edge = (nearer > 0) & ((first - second).abs() > DEPTH_STEP * nearer)
        edges.narrow(axis, 0, count).logical_or_(is_edge)
        edges.narrow(axis, 1, count).logical_or_(is_edge)
    return edges


def region_of(
    mask: Bool[Tensor, "n h w"], name: str, depth: Float[Tensor, "n h w"] | None = None
) -> Bool[Tensor, "n h w"] | None:
    """The pixels of a region.

    Args:
        mask: of the subject.
        name: one of :data:`REGIONS`.
        depth: true z in metres, 0 where unknown; its edges belong to ``edge``. None: unknown.

    Returns:
        A mask; None for the whole image.

    Raises:
        InputError: there is no such region."""
    choice("region", name, REGIONS)
    if name == "image":
        return None
    if name == "crop":
        return crop_of(mask)
    if name == "edge":
        outline = grown(mask, EDGE) & grown(~mask, EDGE)
        return outline if depth is None else outline | grown(depth_edges(depth), EDGE - 1)
    return box_of(mask) if name == "box" else mask
