"""Masks as silhouettes: dilated, at a limited resolution, and looked up at projected points."""

from dataclasses import dataclass
from math import ceil

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Int, Shaped, UInt8
from torch import Tensor

from ghgs_lit.geometry.projection import at_least_float32
from ghgs_lit.types import Cameras

#: The least depth at which masks are looked up, in metres; points behind the camera are moved there.
NEAREST = 1e-4


@dataclass(frozen=True)
class Silhouettes:
    """Masks of cells of ``stride`` x ``stride`` pixels, the cameras of the cells, and a dilation in cells."""

    masks: Bool[Tensor, "B V h w"]
    cameras: Cameras
    stride: int
    dilation: int


def silhouettes(
    masks: Bool[Tensor, "B V H W"], cameras: Cameras, resolution: int, dilation: float
) -> Silhouettes:
    """Masks at a resolution that limits the cost of the search. ``resolution``: cells along the longer side
    of the image, at most. ``dilation``: as a fraction of the image's longer side."""
    stride = ceil(max(masks.shape[-2:]) / resolution)
    if stride > 1:
        masks = F.max_pool2d(masks.float(), stride, stride, ceil_mode=True).bool()
    height, width = masks.shape[-2:]
    # Whole cells: the last row and column of them may reach beyond the image.
    matrices = map(at_least_float32, (cameras.intrinsics, cameras.extrinsics))
    full = Cameras(*matrices, height * stride, width * stride)
    return Silhouettes(masks, full.resized(height, width), stride, ceil(dilation * max(height, width)))


def dilate(masks: Bool[Tensor, "*batch h w"], radius: int | Tensor) -> Bool[Tensor, "*batch h w"]:
    """Masks grown by ``radius`` pixels along both axes (at a cost that does not depend on it). ``masks``: to
    be grown. ``radius``: one for all masks, or integers that broadcast with them."""
    grown = masks
    for dim in (-2, -1):
        size = masks.shape[dim]
        index = torch.arange(size, device=masks.device)
        index = index[:, None] if dim == -2 else index
        counts = F.pad(grown.cumsum(dim, dtype=torch.int32), (0, 0, 1, 0) if dim == -2 else (1, 0))
        high, low = (index + radius + 1).clamp(max=size), (index - radius).clamp(min=0)
        high, low = (counts.gather(dim, ends.long().expand(masks.shape)) for ends in (high, low))
        grown = high > low
    return grown


def votes_outside(dilated: Bool[Tensor, "B V h w"], voting: Bool[Tensor, "B V"]) -> UInt8[Tensor, "B V h w"]:
    """1 where a view that votes says "outside the subject"."""
    return (~dilated & voting[..., None, None]).to(torch.uint8)


def look_up(
    tables: Shaped[Tensor, "n h w"], image: Int[Tensor, "..."], x: Tensor, y: Tensor, w: Tensor
) -> Tensor:
    """Entries of ``tables`` at homogeneous pixels; overwrites ``x``, ``y`` and ``w``.

    Points outside the frame take the entry of the nearest border pixel: a mask that does not touch the border
    has the whole subject in its frame. Points behind the camera land far outside the frame. ``image``: which
    table; broadcasts with the pixels. ``x``, ``y``, ``w``: homogeneous pixels.
    """
    height, width = tables.shape[1:]
    inverse = w.clamp_(min=NEAREST).reciprocal_()
    # Cameras of absurd sizes overflow to NaN, which has no index.
    column = x.mul_(inverse).nan_to_num_().clamp_(0, width - 1).int()
    row = y.mul_(inverse).nan_to_num_().clamp_(0, height - 1).int()
    return tables.flatten().take(row.mul_(width).add_(column) + image * (height * width))
