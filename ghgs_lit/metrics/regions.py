"""Image regions in which metrics are measured, and means over them."""

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from ghgs_lit.geometry.masks import between

EDGE = 2
"""Largest distance from the subject's outline in the region ``edge``, in rows and columns."""
DEPTH_STEP = 0.02
"""Least relative difference in depth of neighbouring pixels at a depth edge: 5 cm at 2.5 m."""


def mean_over(values: Float[Tensor, "n h w"], region: Bool[Tensor, "n h w"] | None) -> Float[Tensor, " n"]:
    """Mean of each map over its region (None: all pixels); nan if the region is empty."""
    if region is None:
        return values.mean((-2, -1))
    count = region.sum((-2, -1))
    total = torch.where(region, values, torch.zeros_like(values)).sum((-2, -1))
    return torch.where(count > 0, total / count.clamp(min=1), torch.full_like(total, torch.nan))


def box_of(mask: Bool[Tensor, "n h w"]) -> Bool[Tensor, "n h w"]:
    """Bounding box of each mask, as a mask; empty if the mask is empty."""
    return between(mask.any(-1))[:, :, None] & between(mask.any(-2))[:, None, :]


def grown(mask: Bool[Tensor, "n h w"], pixels: int) -> Bool[Tensor, "n h w"]:
    """Dilate masks by a square of ``2 * pixels + 1``."""
    return F.max_pool2d(mask[:, None].float(), 2 * pixels + 1, 1, pixels)[:, 0].bool()


def depth_edges(depth: Float[Tensor, "n h w"]) -> Bool[Tensor, "n h w"]:
    """Pixels on both sides of a depth edge, at which neighbours differ by more than :data:`DEPTH_STEP`.

    Args:
        depth: z in metres; 0: unknown, never an edge."""
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
    """Pixels of a region, as a mask; None for the whole image.

    Args:
        mask: of the subject.
        name: ``image``, ``box``, ``subject`` or ``edge``.
        depth: true z in metres, 0 where unknown, whose edges belong to ``edge``; None: unknown."""
    if name == "edge":
        outline = grown(mask, EDGE) & grown(~mask, EDGE)
        return outline if depth is None else outline | grown(depth_edges(depth), EDGE - 1)
    return {"image": None, "box": box_of(mask), "subject": mask}[name]
