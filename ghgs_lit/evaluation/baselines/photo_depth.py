"""Depth without a network: from silhouettes alone, and by a plane sweep within their visual hull."""

import torch
import torch.nn.functional as F
from torch import Tensor

from ghgs_lit.bounds import VisualHull
from ghgs_lit.geometry.photo_consistency import photo_consistency
from ghgs_lit.types import Batch, DepthBounds

#: Finer and closer to the masks than the bounds of a model, which must hold the subject whatever the masks.
HULL = VisualHull(dilation=0.005, samples=192)


def hull_bounds(batch: Batch) -> DepthBounds:
    """Where the ray of each pixel enters and leaves the visual hull."""
    return HULL(batch)


def hull_depth(batch: Batch) -> Tensor:
    """The hull's first surface along the ray of each pixel of the subject [B, V, H, W], metres; 0 elsewhere.

    The photographs coloured by it are the image-based visual hull (Matusik et al. 2000).
    """
    return batch.once(hull_bounds).near * batch.masks


#: Tuned on four people, with 3 to 5 views: depths that are compared; half the side of the window in which
#: pixels share their evidence, as a part of the longer side of the image; and the difference of consistency
#: at which a depth counts 1 / e of the best one.
DEPTHS, WINDOW, SOFTNESS = 32, 0.02, 0.03


def photo_depth(batch: Batch) -> Tensor:
    """Depths at which pixels and their neighbours agree best with another view [B, V, H, W], metres.

    The mean of the depths of a plane sweep, weighted by their consistency (the soft argmin of Kendall et al.,
    ICCV 2017); the middle of the hull where all are alike. 0 outside the subject.
    """
    bounds = batch.once(hull_bounds)
    consistency = photo_consistency(batch, bounds, DEPTHS)
    radius = max(round(WINDOW * max(batch.masks.shape[-2:])), 1)
    weights = (_shared(consistency, batch.masks, radius) / SOFTNESS).softmax(2)
    shares = (torch.arange(DEPTHS, device=weights.device, dtype=weights.dtype) + 0.5) / DEPTHS
    share = torch.einsum("bvshw,s->bvhw", weights, shares)
    return (bounds.near + (bounds.far - bounds.near) * share) * batch.masks


def _shared(values: Tensor, masks: Tensor, radius: int) -> Tensor:
    """Means of ``values`` [B, V, S, H, W] over the subject's pixels in a window around each pixel."""
    inside = masks.to(values.dtype)
    counts = _window_mean(inside, radius)
    sums = _window_mean((values * inside[:, :, None]).flatten(1, 2), radius).view_as(values)
    return sums / torch.where(counts > 0, counts, 1.0)[:, :, None]


def _window_mean(maps: Tensor, radius: int) -> Tensor:
    """Means over a square window [B, n, H, W], beyond the border 0; rows, then columns."""
    side = 2 * radius + 1
    maps = F.avg_pool2d(maps, (side, 1), 1, (radius, 0))
    return F.avg_pool2d(maps, (1, side), 1, (0, radius))
