"""Measurement without training or data: random weights,
and a subject of a given size in the frame."""

import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import nn

from ghgs_lit.errors import require
from ghgs_lit.method.model import GHGS
from ghgs_lit.types import Batch, Cameras, Targets

#: Width over height of the silhouette, as of a standing person,
#: and its largest height over the frame's.
_ASPECT = 0.4
_TALLEST = 0.9


def ellipse(share: float, size: tuple[int, int]) -> torch.Tensor:
    """Mask of an upright ellipse in the middle of the frame.

    Args:
        share: of the frame's area that the ellipse covers, above 0.
        size: (height, width) in pixels.

    Returns:
        Mask [height, width].

    Raises:
        InputError: no upright ellipse of at most 0.9 of the height can cover so much.
    """
    # share = pi / 4 * width * height, both as parts of the frame
    height = min(math.sqrt(4 * share * size[1] / (math.pi * _ASPECT * size[0])), _TALLEST)
    width = 4 * share / (math.pi * height)
    require(share > 0 and width <= 1, "share", "a part of the frame that an upright ellipse can cover", share)
    row, column = ((torch.arange(side) + 0.5) / side - 0.5 for side in size)
    return (row / height)[:, None].square() + (column / width).square() < 0.25


def ring(count: int, height: int, width: int) -> Cameras:
    """Cameras that look at the origin from 2 m, evenly around the y axis.

    Args:
        count: number of cameras.
        height: of the images in pixels; the focal length is one height.
        width: of the images in pixels.

    Returns:
        Cameras [count].
    """
    yaw = 2 * math.pi * torch.arange(count, dtype=torch.float64) / count
    zero = torch.zeros_like(yaw)
    right = torch.stack((yaw.cos(), zero, -yaw.sin()), -1)
    down = torch.tensor((0.0, -1.0, 0.0), dtype=yaw.dtype).expand(count, 3)
    forward = torch.stack((-yaw.sin(), zero, -yaw.cos()), -1)
    extrinsics = torch.eye(4).repeat(count, 1, 1)
    extrinsics[:, :3, :3] = torch.stack((right, down, forward), -2)
    extrinsics[:, 2, 3] = 2.0
    intrinsics = torch.tensor([[height, 0, width / 2], [0, height, height / 2], [0, 0, 1]])
    return Cameras(intrinsics.repeat(count, 1, 1), extrinsics, height, width)


def ellipsoid_batch(share: float, views: int, size: int | tuple[int, int], batch: int) -> Batch:
    """Batch of photographs of noise on an ellipsoid of revolution;
    the mask is the same in every view.

    Args:
        share: part of the frame that the subject covers.
        views: number of input views; the first one is the target, too.
        size: side, or (height, width), in pixels.
        batch: number of elements, all alike but for the noise.

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
    """A model with random weights, made faster than by the usual initialisation.

    No last layer is 0, unlike at the start of training, so that every output depends on the
    photographs.

    Args:
        config: the nodes of the model as plain data.
        seed: of the weights.

    Returns:
        The model in evaluation mode on the CPU; no weight has a gradient.
    """
    generator = torch.Generator().manual_seed(seed)
    with torch.device("meta"):
        model = GHGS.from_config(config)
    for module in model.modules():
        for name, parameter in module._parameters.items():
            if parameter is None:
                continue
            if parameter.dim() == 1:
                value = torch.full(parameter.shape, float(name in ("weight", "gamma")))
            else:
                value = torch.randn(parameter.shape, generator=generator) * parameter[0].numel() ** -0.5
            module._parameters[name] = nn.Parameter(value, requires_grad=False)
    return model.eval()
