"""Extents of masks, indices of their pixels, and sizes of shape buckets."""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Int
from torch import Tensor


class Extent(NamedTuple):
    """Number of pixels of a mask, and its bounding box (ends excluded; undefined for an empty mask)."""

    count: int
    top: int
    bottom: int
    left: int
    right: int

    def coarser(self, stride: int, count: int) -> "Extent":
        """The extent in cells of ``stride`` x ``stride`` pixels.

        Args:
            stride: side of a cell in pixels.
            count: number of cells with a pixel of the mask.

        Returns:
            The extent, whose bounding box contains all these cells.
        """
        bottom = (self.bottom - 1) // stride + 1
        right = (self.right - 1) // stride + 1
        return Extent(count, self.top // stride, bottom, self.left // stride, right)

    def cells(self, stride: int) -> int:
        """Number of cells of ``stride`` x ``stride`` pixels that the bounding box overlaps.

        Args:
            stride: side of a cell in pixels.

        Returns:
            The number; 0 for an empty mask.
        """
        _, top, bottom, left, right = self.coarser(stride, 0)
        return (bottom - top) * (right - left) if self.count else 0


def extents(masks: Bool[Tensor, "n H W"]) -> list[Extent]:
    """Extent of each of n masks, with one device-to-host synchronisation."""
    return [Extent(*numbers) for numbers in extent_numbers(masks).tolist()]


def extent_numbers(masks: Bool[Tensor, "n H W"]) -> Int[Tensor, "n 5"]:
    """Fields of each mask's :class:`Extent`, on the device of the masks, without a synchronisation.

    Args:
        masks: [n, H, W].

    Returns:
        Count, top, bottom, left and right [n, 5].
    """
    numbers = [masks.sum((1, 2))]
    for lines in (masks.any(2).to(torch.uint8), masks.any(1).to(torch.uint8)):
        numbers += [lines.argmax(1), lines.shape[1] - lines.flip(1).argmax(1)]
    return torch.stack(numbers, dim=1)


def true_places(mask: Bool[Tensor, "..."], count: int, repeats: bool = False) -> Int[Tensor, " n"]:
    """Flat indices of the True values, as ``nonzero`` but without a device-to-host synchronisation.

    Args:
        mask: bools of any shape.
        count: number of True values.
        repeats: allow fewer True values; on a GPU, the first index is repeated for the missing ones.

    Returns:
        Ascending indices [count].
    """
    flat = mask.flatten()
    if flat.device.type == "cpu":
        return flat.nonzero()[:, 0]
    index = torch.arange(len(flat), device=flat.device)
    target = torch.where(flat, flat.cumsum(0) - 1, count)  # False: to the last index, cut off below
    places = flat.to(torch.uint8).argmax().repeat(count + 1) if repeats else index.new_empty(count + 1)
    return places.scatter_(0, target, index)[:count]


#: Shape buckets per octave.
_STEPS = 8


def bucket_size(count: int) -> int:
    """The smallest shape bucket for ``count`` rows.

    Buckets are 1 to 16, then eight of equal steps in each octave (18, 20, ..., 32, 36, ...): at most
    an eighth of the rows is padding.
    """
    step = max((1 << max(count - 1, 0).bit_length()) // (2 * _STEPS), 1)
    return -(-count // step) * step
