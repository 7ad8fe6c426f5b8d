"""Splats of each image tile in order of depth, without a device-to-host synchronisation.

gsplat's function copies the number of intersections to the host, and the GPU idles until the host has
read it and has launched the next kernels. Here arrays have a fixed capacity instead, and the required
number is a tensor that can be read later (:mod:`ghgs_lit.rendering.capacity`)."""

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

    Each image has an additional row of tiles below it, which contains no pixels; its last tile holds
    the unused entries: in gsplat's kernels a tile ends where the next one begins, and the last tile
    at the capacity.

    Attributes:
        splats: indices among the splats of all images, in the order of gsplat's sorted keys: by image,
            tile, bits of the depth, index.
        offsets: first entry of each tile.
        has_pixels: false in the additional rows, which gsplat then skips in the backward pass.
        needed: number of intersections; if it exceeds the capacity, the farthest splats are missing."""

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
    """Intersect splats with tiles, like gsplat's ``isect_tiles`` and ``isect_offset_encode``.

    Splats are sorted by depth first, then their intersections by tile. Both sorts are stable, so that
    the order is that of gsplat's 64-bit keys, but most bytes are sorted once per splat instead of
    once per intersection.

    Args:
        centers: centres in pixels; arbitrary where a radius is 0.
        radii: half sides in pixels of the box that a splat touches; 0 for a splat that is not rendered.
        depths: float32, above 0 for splats that are rendered.
        height: image height in pixels.
        width: image width in pixels.
        capacity: number of entries, at least 1.

    Returns:
        The splats of each tile in order of depth, and the number of entries that they need.
    """
    shape = depths.shape[:-1]
    rows = -(-height // TILE)
    columns = -(-width // TILE)
    tiles = shape.numel() * (rows + 1) * columns
    # Radix sort: the time is proportional to the number of bytes of a key.
    kind = torch.int16 if tiles <= 2**15 else torch.int32
    every = constant(torch.arange, tiles, like=centers, dtype=kind)
    has_pixels = constant(_have_pixels, *shape, rows, columns, like=centers, dtype=torch.bool)
    centers = centers.reshape(-1, depths.shape[-1], 2)
    radii = radii.reshape(centers.shape)
    _, order = depths.contiguous().view(torch.int32).flatten().sort(stable=True)
    boxes = _BOXED(centers, radii, order, rows, columns)
    ends = boxes[0].cumsum(0)
    tile, splat = _PLACED(ends, boxes, order, every, capacity, columns)
    tile, order = tile.sort(stable=True)
    offsets = torch.searchsorted(tile, every, out_int32=True).view(has_pixels.shape)
    return Intersections(splat[order], offsets, has_pixels, ends[-1])


def _find_tiles(
    centers: Float[Tensor, "I N 2"],
    radii: Int[Tensor, "I N 2"],
    order: Int[Tensor, " I*N"],
    rows: int,
    columns: int,
) -> Int32[Tensor, "3 I*N"]:
    """Find the tiles of each splat.

    Args:
        centers: in pixels.
        radii: half sides in pixels; 0 for a splat that is not rendered.
        order: indices of the splats of all images, in the order of the result.
        rows: tile rows of an image that have pixels.
        columns: tile columns of an image.

    Returns:
        Number of tiles of each splat, index of the first tile, and number of tiles across (at least 1).
    """
    sizes = constant(torch.tensor, (columns, rows), like=centers)
    reach = radii / TILE
    begin = torch.clamp(torch.floor(centers / TILE - reach), centers.new_zeros(()), sizes).int()
    end = torch.clamp(torch.ceil(centers / TILE + reach), centers.new_zeros(()), sizes).int()
    size = end - begin
    image = constant(torch.arange, len(centers), like=order)
    first = image[:, None] * ((rows + 1) * columns) + begin[..., 1] * columns + begin[..., 0]
    tiles = size.prod(-1) * (radii > 0).all(-1)
    boxes = torch.stack((tiles, first, size[..., 0].clamp(min=1)))
    return boxes.flatten(1)[:, order].int()


def _list_intersections(
    ends: Int[Tensor, " N"],
    boxes: Int32[Tensor, "3 N"],
    order: Int[Tensor, " N"],
    every: Int[Tensor, " tiles"],
    capacity: int,
    columns: int,
) -> tuple[Int[Tensor, " capacity"], Int32[Tensor, " capacity"]]:
    """List all intersections: splats one after another, the tiles of each splat row by row.

    Args:
        ends: end of each splat's intersections, the cumulative number of tiles.
        boxes: from :func:`_find_tiles`.
        order: indices of the splats in ``ends`` and ``boxes``.
        every: indices of all tiles; unused entries get the last one.
        capacity: number of entries.
        columns: tile columns of an image.

    Returns:
        The tile of each entry, in the dtype of ``every``, and its splat.
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
    _find_tiles,
    __name__,
    {"cuda": everything},
)
_PLACED = Operator(
    "placed(Tensor ends, Tensor boxes, Tensor order, Tensor every, int capacity, int columns) "
    "-> (Tensor, Tensor)",
    _list_intersections,
    __name__,
    {"cuda": everything},
)


def _have_pixels(*shape: int, **kind: object) -> Tensor:
    """Ones [..., rows, columns] with another row of zeros."""
    ones = torch.ones(shape, **kind)
    return torch.cat((ones, torch.zeros_like(ones[..., :1, :])), -2)
