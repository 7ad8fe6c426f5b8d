"""Which splats each tile of an image draws, in order of depth, without a wait of the host.

gsplat's own function asks the device for the number of intersections, and the GPU idles until the
host has read it and has launched what follows. Here arrays have a fixed capacity instead, and the
number needed is a tensor that can be read later (:mod:`ghgs_lit.rendering.capacity`)."""

from functools import cache
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int, Int32
from torch import Tensor

from ghgs_lit.geometry.constants import constant
from ghgs_lit.ops.dispatch import Operator, everything

#: Side of a tile in pixels: gsplat's default.
TILE = 16


class Intersections(NamedTuple):
    """Splats of all tiles, one tile after another.

    Each image has a row of tiles below its own. No pixel lies in it, and the very last tile holds
    the places that are not used: in gsplat's kernels a tile ends where the next one begins, the
    last at the capacity.

    Attributes:
        splats: index among all images' splats, in the order of gsplat's sorted keys: by image,
            tile, bits of the depth, index.
        offsets: first place of each tile.
        has_pixels: false in the rows below the images,
            which gsplat then skips in the backward pass.
        needed: number of intersections; where it exceeds the capacity,
            the farthest splats are missing."""

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

    Splats are sorted by depth first, and then their places by tile. Both sorts are stable, so that
    the order is that of gsplat's 64-bit keys, but most bytes are sorted once for a splat instead of
    once for a tile.

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
    rows = -(-height // TILE)
    columns = -(-width // TILE)
    fixed = _fixed(shape, rows, columns, centers.device)
    centers = centers.reshape(-1, depths.shape[-1], 2)
    radii = radii.reshape(centers.shape)
    _, order = depths.contiguous().view(torch.int32).flatten().sort(stable=True)
    boxes = _BOXED(centers, radii, order, rows, columns)
    ends = boxes[0].cumsum(0)
    tile, splat = _PLACED(ends, boxes, order, fixed.every, capacity, columns)
    # A radix sort passes once over each byte.
    tile, order = tile.sort(stable=True)
    offsets = torch.searchsorted(tile, fixed.every, out_int32=True).view(fixed.has_pixels.shape)
    return Intersections(splat[order], offsets, fixed.has_pixels, ends[-1])


def _boxed(
    centers: Float[Tensor, "I N 2"],
    radii: Int[Tensor, "I N 2"],
    order: Int[Tensor, " I*N"],
    rows: int,
    columns: int,
) -> Int32[Tensor, "3 I*N"]:
    """Tiles of each splat.

    Args:
        centers: in pixels.
        radii: half sides in pixels; 0 where a splat is not drawn.
        order: splats of all images, in the order of the result.
        rows: of tiles that have pixels, in one image.
        columns: of tiles in one image.

    Returns:
        Number of each splat's tiles, index of the first one, and the number across (1 or more).
    """
    sizes = constant(_sizes, columns, rows, like=centers)
    reach = radii / TILE
    begin = torch.clamp(torch.floor(centers / TILE - reach), centers.new_zeros(()), sizes).int()
    end = torch.clamp(torch.ceil(centers / TILE + reach), centers.new_zeros(()), sizes).int()
    size = end - begin
    image = constant(torch.arange, len(centers), like=order)
    first = image[:, None] * ((rows + 1) * columns) + begin[..., 1] * columns + begin[..., 0]
    tiles = size.prod(-1) * (radii > 0).all(-1)
    boxes = torch.stack((tiles, first, size[..., 0].clamp(min=1)))
    return boxes.flatten(1)[:, order].int()


def _sizes(columns: int, rows: int, **kind: object) -> Tensor:
    """Tiles across and down, [2]."""
    return torch.tensor((columns, rows), **kind)


def _placed(
    ends: Int[Tensor, " N"],
    boxes: Int32[Tensor, "3 N"],
    order: Int[Tensor, " N"],
    every: Int[Tensor, " tiles"],
    capacity: int,
    columns: int,
) -> tuple[Int[Tensor, " capacity"], Int32[Tensor, " capacity"]]:
    """What each place holds: splats one after another, the tiles of each by rows.

    Args:
        ends: places up to the end of each splat's.
        boxes: as of :func:`_boxed`.
        order: splats of the rows of ``ends`` and ``boxes``.
        every: numbers of all tiles; places that no splat needs are of the last one.
        capacity: number of places.
        columns: of tiles in one image.

    Returns:
        The tile of each place, in the type of ``every``, and its splat.
    """
    place = constant(torch.arange, capacity, like=ends)
    row = torch.searchsorted(ends, place, right=True)
    is_needed = row < len(order)
    row = row.clamp(max=len(order) - 1)
    number, first, across = boxes[:, row]
    step = place - (ends[row] - number)
    below = step // across
    tile = torch.where(is_needed, first + below * columns + step - below * across, len(every) - 1)
    return tile.to(every.dtype), torch.where(is_needed, order[row], len(order) - 1).int()


_BOXED = Operator(
    "boxed(Tensor centers, Tensor radii, Tensor order, int rows, int columns) -> Tensor",
    _boxed,
    __name__,
    {"cuda": everything},
)
_PLACED = Operator(
    "placed(Tensor ends, Tensor boxes, Tensor order, Tensor every, int capacity, int columns) "
    "-> (Tensor, Tensor)",
    _placed,
    __name__,
    {"cuda": everything},
)


class _Fixed(NamedTuple):
    """What depends on the number and the size of images alone.

    Attributes:
        every: numbers of all tiles, with the row below each image.
        has_pixels: as of :class:`Intersections`.
    """

    every: Tensor
    has_pixels: Tensor


# without a limit: a recorded CUDA graph draws with them
@cache
# a validation may ask first, and a training step has them in its graph
@torch.inference_mode(False)
def _fixed(images: torch.Size, rows: int, columns: int, device: torch.device) -> _Fixed:
    """Constants of :func:`intersections` on a device, kept for later calls.

    Args:
        images: shape of the batch of images.
        rows: of tiles that have pixels, in one image.
        columns: of tiles in one image.
        device: where the tensors are needed.
    """
    count = images.numel() * (rows + 1) * columns
    every = torch.arange(count, dtype=torch.int16 if count <= 2**15 else torch.int32)
    has_pixels = torch.ones(*images, rows + 1, columns, dtype=torch.bool)
    has_pixels[..., -1, :] = False
    return _Fixed(every.to(device, non_blocking=True), has_pixels.to(device, non_blocking=True))
