"""Inputs of measurements without data or training: a subject of a given size in the frame, and random
weights."""

import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import nn

from ghgs_lit.errors import require
from ghgs_lit.method.model import GHGS
from ghgs_lit.types import Batch, Cameras, Targets
from ghgs_lit.visualization.turntable import turntable

#: Width of the silhouette over its height, as of a standing person, and its largest height over the frame's.
_ASPECT = 0.4
_TALLEST = 0.9


def ellipse(share: float, size: tuple[int, int]) -> torch.Tensor:
    """Mask of an upright ellipse in the middle of the frame.

    Args:
        share: part of the frame's area that the ellipse covers, above 0.
        size: (height, width) in pixels.

    Returns:
        Mask [height, width].

    Raises:
        InputError: an upright ellipse of 0.9 of the frame's height cannot cover so much.
    """
    # share = pi / 4 * width * height, both as parts of the frame
    height = min(math.sqrt(4 * share * size[1] / (math.pi * _ASPECT * size[0])), _TALLEST)
    width = 4 * share / (math.pi * height)
    require(share > 0 and width <= 1, "share", "a part of the frame that an upright ellipse can cover", share)
    row, column = ((torch.arange(side) + 0.5) / side - 0.5 for side in size)
    return (row / height)[:, None].square() + (column / width).square() < 0.25


def ring(count: int, height: int, width: int) -> Cameras:
    """Cameras [count] that look at the origin from 2 m, evenly around the y axis.

    Args:
        count: number of cameras.
        height: of the images in pixels; the focal length is one height.
        width: of the images in pixels.
    """
    intrinsics = torch.tensor([[[height, 0, width / 2], [0, height, height / 2], [0, 0, 1]]])
    first = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))
    first[2, 3] = 2.0
    return turntable(Cameras(intrinsics, first[None], height, width), count, torch.zeros(1, 3))


def ellipsoid_batch(share: float, views: int, size: int | tuple[int, int], batch: int) -> Batch:
    """Batch of views of an ellipsoid of revolution, with noise as colours. All masks are equal.

    Args:
        share: part of the frame's area that the subject covers.
        views: number of input views; the first one is also the target.
        size: side, or (height, width), in pixels.
        batch: number of elements, which differ in their noise only.

    Raises:
        InputError: as for :func:`ellipse`.
    """
    size = (size, size) if isinstance(size, int) else size
    cameras = ring(views, *size)[None][torch.zeros(batch, dtype=torch.long)]
    masks = ellipse(share, size).expand(batch, views, -1, -1).contiguous()
    noise = torch.rand(batch, views, 3, *size, generator=torch.Generator().manual_seed(0))
    images = noise * masks[:, :, None]
    return Batch(images, masks, cameras, Targets(images[:, :1], masks[:, :1], cameras[:, :1]))


@torch.no_grad()
def random_model(config: Mapping[str, Any], seed: int = 0) -> GHGS:
    """A model with random weights, faster than the initialisation of a training.

    No last layer is 0, unlike at the start of training, so that every output depends on the inputs.

    Args:
        config: the nodes of the model as plain data.
        seed: of the weights.

    Returns:
        The model in evaluation mode on the CPU; no weight has a gradient.
    """
    generator = torch.Generator().manual_seed(seed)
    model = GHGS.from_config(config, empty=True)
    for module in model.modules():
        for name, parameter in list(module.named_parameters(recurse=False)):
            if parameter.dim() == 1:
                value = torch.full(parameter.shape, float(name in ("weight", "gamma")))
            else:
                value = torch.randn(parameter.shape, generator=generator) * parameter[0].numel() ** -0.5
            setattr(module, name, nn.Parameter(value, requires_grad=False))
    return model.eval()
