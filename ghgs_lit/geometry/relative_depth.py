"""Depths told from the middle of the subject, as maps that a network can look at."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ghgs_lit.bounds.visual_hull import Interval

#: Metres that become 1: about the depth of a body.
UNIT = 0.25

#: Channels of :func:`relative_interval`.
INTERVAL_CHANNELS = 2


def subject_mean(values: Float[Tensor, "B V H W"], masks: Bool[Tensor, "B V H W"]) -> Tensor:
    """Mean over the subject's pixels of each view, [B, V, 1, 1]; 0 for a view without any."""
    count = masks.sum((-2, -1), keepdim=True)
    return torch.where(masks, values, 0).sum((-2, -1), keepdim=True) / count.clamp(min=1)


def relative_interval(interval: Interval, masks: Bool[Tensor, "B V H W"]) -> Float[Tensor, "B V 2 H W"]:
    """Where a pixel's interval of depths begins, from the middle of its view's, and how long it is.

    In units of :data:`UNIT`, 0 outside the subject: what masks and cameras say about the shape.
    """
    near, far = interval
    middle = subject_mean((near + far) / 2, masks)
    maps = torch.stack((near - middle, far - near), dim=2) / UNIT
    return torch.where(masks[:, :, None], maps, 0)


def relative_depth(
    depth: Float[Tensor, "B V H W"], masks: Bool[Tensor, "B V H W"]
) -> Float[Tensor, "B V 1 H W"]:
    """Depth from its mean over the view's subject, in units of :data:`UNIT`; without a gradient."""
    depth = depth.detach()
    return torch.where(masks, (depth - subject_mean(depth, masks)) / UNIT, 0)[:, :, None]
