"""A subject of a given size in the frame: an ellipsoid before a ring of cameras, for the scaling study."""

import math

import numpy as np
import torch

from ghgs_lit.errors import require
from ghgs_lit.synthesis.rig import Rig
from ghgs_lit.types import Batch, Targets

#: Width to height of the silhouette while it fits, as of a standing person; and its largest height as a part
#: of the frame's.
_ASPECT, _TALLEST = 0.4, 0.9


def ellipse(share: float, size: int) -> torch.Tensor:
    """A mask [size, size] of an upright ellipse in the middle that covers ``share`` of the frame."""
    # share = pi / 4 * width * height, both as parts of the frame
    height = min(math.sqrt(4 * share / (math.pi * _ASPECT)), _TALLEST)
    width = 4 * share / (math.pi * height)
    require(share > 0 and width <= 1, "scaling.share", "a part of the frame from 0 to 0.7", share)
    place = (torch.arange(size) + 0.5) / size - 0.5
    return (place / height)[:, None].square() + (place / width).square() < 0.25


def ellipsoid_batch(share: float, views: int, size: int, batch: int, seed: int = 0) -> Batch:
    """Photographs of noise on an ellipsoid of revolution, which looks the same in every view.

    Args:
        share: part of the frame that the subject covers.
        views: number of input views, at even angles.
        size: side of the photographs in pixels.
        batch: number of elements.
        seed: of the noise.

    Returns:
        The batch; its target is the first input view.
    """
    rig = Rig(look_at=(0.0, 0.0, 0.0), pitch=0.0, focal=1.0, shift_y=0.0)
    yaws = np.tile(np.arange(views) * 360.0 / views, (batch, 1))
    cameras = rig.cameras(yaws, size, size)
    masks = ellipse(share, size).expand(batch, views, -1, -1).contiguous()
    noise = torch.rand(batch, views, 3, size, size, generator=torch.Generator().manual_seed(seed))
    images = noise * masks[:, :, None]
    return Batch(images, masks, cameras, Targets(images[:, :1], masks[:, :1], cameras[:, :1]))
