"""Depths relative to the middle of the subject, as input maps of a network."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ghgs_lit.types import DepthBounds

#: Metres that become 1: about the depth of a body.
UNIT = 0.25

#: Channels of :func:`relative_bounds`.
BOUNDS_CHANNELS = 2


def subject_mean(
    values: Float[Tensor, "B V H W"], masks: Bool[Tensor, "B V H W"]
) -> Float[Tensor, "B V 1 1"]:
    """Mean over the subject's pixels of each view; 0 for a view without any."""
    count = masks.sum((-2, -1), keepdim=True)
    return torch.where(masks, values, 0).sum((-2, -1), keepdim=True) / count.clamp(min=1)


def relative_bounds(bounds: DepthBounds, masks: Bool[Tensor, "B V H W"]) -> Float[Tensor, "B V 2 H W"]:
    """The bounds as two maps: what masks and cameras say about the shape, not about the distance. ``bounds``:
    near and far in metres. Returns: ``near`` minus the mean middle of the view's bounds, and ``far - near``,
    in units of :data:`UNIT`; 0 outside the subject."""
    middle = subject_mean((bounds.near + bounds.far) / 2, masks)
    maps = torch.stack((bounds.near - middle, bounds.far - bounds.near), dim=2) / UNIT
    return torch.where(masks[:, :, None], maps, 0)


def relative_depth(
    depth: Float[Tensor, "B V H W"], masks: Bool[Tensor, "B V H W"]
) -> Float[Tensor, "B V 1 H W"]:
    """Depth minus its mean over the view's subject, in units of :data:`UNIT`, without a gradient. ``depth``:
    in metres. ``masks``: of the subject; the map is 0 outside."""
    depth = depth.detach()
    return torch.where(masks, (depth - subject_mean(depth, masks)) / UNIT, 0)[:, :, None]
