"""Colouring of the visual hull: what silhouettes alone say."""

from torch import Tensor

from ghgs_lit.bounds import VisualHull
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
