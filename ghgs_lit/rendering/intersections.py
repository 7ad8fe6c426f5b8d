"""Which splats each tile of an image draws, in order of depth, without a wait of the host.

gsplat's own function asks the device for the number of intersections, and the GPU idles until the host has
read it and has launched what follows. Here arrays have a fixed capacity instead, and the number needed is a
tensor that can be read later (:mod:`ghgs_lit.rendering.capacity`)."""

from functools import lru_cache
from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int, Int32
from torch import Tensor

#: Side of a tile in pixels: gsplat's default.
TILE = 16


class Intersections(NamedTuple):
    """Splats of all tiles, one tile after another.

    Each image has a row of tiles below its own. No pixel lies in it, and the very last tile holds the places
    that are not used: in gsplat's kernels a tile ends where the next one begins, the last at the capacity.

    Attributes:
        splats: index among all images' splats, in the order of gsplat's sorted keys: by image, tile, bits of
            the depth, index.
        offsets: first place of each tile.
        has_pixels: false in the rows below the images, which gsplat then skips in the backward pass.
        needed: number of intersections; where it exceeds the capacity, the farthest splats are missing."""

    splats: Int32[Tensor, " capacity"]
    offsets: Int32[Tensor, "*images rows columns"]
    has_pixels: Bool[Tensor, "*images rows columns"]
    needed: Int[Tensor, ""]


@torch.no_grad()
def intersections(
    centers: Float[Tensor, "*images N 2"],
    radii: Int[Tensor, "*images N 2"],
    depths: Float[Tensor, "*images N"],
    height: int,
    width: int,
    capacity: int,
) -> Intersections:
    """Intersections of splats with tiles, as gsplat's ``isect_tiles`` and ``isect_offset_encode``.

    Splats are sorted by depth first, and then their places by tile. Both sorts are stable, so that the
    order is that of gsplat's 64-bit keys, but most bytes are sorted once for a splat instead of once for
    a tile.

    Args:
        centers: in pixels; anything where a radius is 0.
        radii: half sides in pixels of the box that a splat touches; 0 where it is not drawn.
        depths: float32, above 0 where a splat is drawn.
        height: of the images, in pixels.
        width: of the images, in pixels.
        capacity: number of places, at least 1.

    Returns:
        The splats of each tile in order of depth, and how many places they need.
    """
    shape = depths.shape[:-1]
    splats = depths.numel()
    rows = -(-height // TILE)
    columns = -(-width // TILE)
    fixed = _fixed(shape, rows, columns, centers.device)
    boxes = _boxes(centers, radii, fixed).view(splats, 3)
    _, order = depths.contiguous().view(torch.int32).flatten().sort(stable=True)
    tiles, first, across = boxes[order].unbind(1)
    ends = tiles.cumsum(0)
    begins = ends - tiles
    # Places behind the last intersection find the last row here, by which their tile is the last one.
    last = len(fixed.every) - 1
    known = F.pad(torch.stack((begins, first - begins, across, order), 1), (0, 0, 0, 1), value=last)
    place = _places(capacity, centers.device)
    begin, shifted, across, splat = known[torch.searchsorted(ends, place, right=True)].unbind(1)
    row = (place - begin) // across
    tile = torch.addcmul(shifted + place, row, columns - across).clamp_(max=last)
    # A radix sort passes once over each byte.
    tile, order = tile.to(fixed.every.dtype).sort(stable=True)
    offsets = torch.searchsorted(tile, fixed.every, out_int32=True).view(fixed.has_pixels.shape)
    return Intersections(splat[order].clamp_(max=splats - 1).int(), offsets, fixed.has_pixels, ends[-1])


def _boxes(centers: Tensor, radii: Tensor, fixed: "_Fixed") -> Tensor:
    """Tiles of each splat.

    Args:
        centers: pixels, [..., N, 2].
        radii: half sides in pixels, [..., N, 2]; 0 where a splat is not drawn.
        fixed: constants of the images' size, from :func:`_fixed`.

    Returns:
        Number of its tiles, index of the first one, and the number across (1 or more), int32 [..., N, 3].
    """
    reach = radii / TILE
    # The negative of the first tile is rounded up as the end is: columns and rows of both, [2, ..., N, 2].
    edges = torch.addcmul(reach, centers, fixed.signs).ceil_()
    edges = torch.clamp(edges, fixed.least, fixed.most).int()
    size = edges.sum(0, dtype=torch.int32)
    column, row = edges[0].unbind(-1)
    columns = fixed.has_pixels.shape[-1]
    first = fixed.first - torch.add(column, row, alpha=columns)
    tiles = size.prod(-1, dtype=torch.int32) * (radii > 0).all(-1)
    return torch.stack((tiles, first, size[..., 0].clamp(min=1)), -1)


class _Fixed(NamedTuple):
    """What depends on the number and the size of images alone.

    Attributes:
        signs: scale of the two ends of boxes, [2, ..., 1, 1].
        least: lower limit of the ends, in tiles, [2, ..., 1, 2].
        most: upper limit of the ends, in tiles, [2, ..., 1, 2].
        first: number of each image's first tile, [..., 1].
        every: numbers of all tiles, with the row below each image.
        has_pixels: as of :class:`Intersections`.
    """

    signs: Tensor
    least: Tensor
    most: Tensor
    first: Tensor
    every: Tensor
    has_pixels: Tensor


@lru_cache(maxsize=64)
@torch.inference_mode(False)  # a validation may ask first, and a training step has them in its graph
def _fixed(images: torch.Size, rows: int, columns: int, device: torch.device) -> _Fixed:
    """Constants of :func:`intersections` on a device, kept for later calls.

    Args:
        images: shape of the batch of images.
        rows: of tiles that have pixels, in one image.
        columns: of tiles in one image.
        device: where the tensors are needed.
    """
    ends = torch.tensor([-1.0, 1.0]).view(2, *[1] * (len(images) + 2))
    limit = torch.tensor([columns, rows], dtype=torch.float32) * ends
    first = torch.arange(images.numel(), dtype=torch.int32) * ((rows + 1) * columns)
    count = images.numel() * (rows + 1) * columns
    every = torch.arange(count, dtype=torch.int16 if count <= 2**15 else torch.int32)
    has_pixels = torch.ones(*images, rows + 1, columns, dtype=torch.bool)
    has_pixels[..., -1, :] = False
    made = _Fixed(
        ends / TILE, limit.clamp(max=0), limit.clamp(min=0), first.view(*images, 1), every, has_pixels
    )
    return _Fixed(*(tensor.to(device, non_blocking=True) for tensor in made))


@lru_cache(maxsize=64)
@torch.inference_mode(False)
def _places(capacity: int, device: torch.device) -> Int[Tensor, " capacity"]:
    """Numbers of the places of intersections, kept for later calls."""
    return torch.arange(capacity, device=device)
