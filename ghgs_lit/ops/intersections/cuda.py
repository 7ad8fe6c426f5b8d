"""Triton kernels of the intersections of splats with tiles; see :mod:`ghgs_lit.ops.intersections`."""

import torch
import triton
import triton.language as tl
from torch import Tensor

from ghgs_lit.ops.tiles import rows_of, start

TILE = tl.constexpr(16)


@triton.jit
def ends_of(center, radius, limit):
    """Range of tiles of a splat along one axis of an image.

    Args:
        center: centre of the splat in pixels.
        radius: half side of the splat's box in pixels.
        limit: number of tiles along this axis.

    Returns:
        The first tile, and the one after the last, from 0 to ``limit``.
    """
    reach = radius.to(tl.float32) / TILE
    middle = center / TILE
    most = limit + 0.0  # Triton makes an integer argument of 1 a compile-time constant
    begin = tl.minimum(tl.maximum(tl.floor(middle - reach), 0.0), most)
    end = tl.minimum(tl.maximum(tl.ceil(middle + reach), 0.0), most)
    return begin.to(tl.int32), end.to(tl.int32)


@triton.jit
def boxed_rows(count, centers, radii, order, out, per_image, rows, columns, ROWS: tl.constexpr):
    """Write the tiles of ``ROWS`` splats; see :func:`boxed`.

    Args:
        count: number N of splats of all images.
        centers: in pixels [N, 2].
        radii: half sides in pixels [N, 2]; 0 for a splat that is not rendered.
        order: indices of splats, in the order of the result [N].
        out: written, number of tiles, first tile and number of tiles across [3, N].
        per_image: number of splats of an image.
        rows: tile rows of an image that have pixels.
        columns: tile columns of an image.
        ROWS: splats per program.
    """
    i = rows_of(count, ROWS)
    splat = tl.load(order + i)
    across = tl.load(radii + 2 * splat)
    down = tl.load(radii + 2 * splat + 1)
    is_drawn = (across > 0) & (down > 0)
    # The centre of a splat that is not rendered may be NaN or infinite.
    x = tl.where(is_drawn, tl.load(centers + 2 * splat), 0.0)
    y = tl.where(is_drawn, tl.load(centers + 2 * splat + 1), 0.0)
    left, right = ends_of(x, across, columns)
    top, bottom = ends_of(y, down, rows)
    image = (splat // per_image).to(tl.int32)
    tl.store(out + i, tl.where(is_drawn, (right - left) * (bottom - top), 0))
    tl.store(out + count + i, image * (rows + 1) * columns + top * columns + left)
    tl.store(out + 2 * count + i, tl.maximum(right - left, 1))


@triton.jit
def placed_rows(
    count, ends, boxes, order, tile, splat, splats, steps, columns, last, ROWS: tl.constexpr
):  # fmt: skip
    """Write ``ROWS`` entries; see :func:`placed`.

    Args:
        count: number of entries.
        ends: end of each splat's intersections, ascending [N].
        boxes: written by :func:`boxed_rows` [3, N].
        order: indices of the splats in ``ends`` and ``boxes`` [N].
        tile: written, the tile of each entry [count].
        splat: written, the splat of each entry [count].
        splats: N.
        steps: steps of the binary search among the splats.
        columns: tile columns of an image.
        last: tile of unused entries.
        ROWS: entries per program.
    """
    place = rows_of(count, ROWS)
    low = tl.zeros_like(place)
    high = low + splats
    for _ in range(steps):
        middle = (low + high) // 2
        is_open = low < high
        is_after = is_open & (tl.load(ends + tl.minimum(middle, splats - 1)) <= place)
        low = tl.where(is_after, middle + 1, low)
        high = tl.where(is_open & (is_after == 0), middle, high)
    is_needed = low < splats
    row = tl.minimum(low, splats - 1)
    number = tl.load(boxes + row)
    first = tl.load(boxes + splats + row)
    across = tl.load(boxes + 2 * splats + row)
    step = (place - (tl.load(ends + row) - number)).to(tl.int32)
    below = step // across
    found = first + below * columns + step - below * across
    tl.store(tile + place, tl.where(is_needed, found, last).to(tile.dtype.element_ty))
    tl.store(splat + place, tl.where(is_needed, tl.load(order + row), splats - 1).to(tl.int32))


def boxed(centers: Tensor, radii: Tensor, order: Tensor, rows: int, columns: int) -> Tensor:
    """Kernel of the operator ``boxed`` of :mod:`ghgs_lit.ops.intersections`.

    Args:
        centers: centres of splats in pixels [I, N, 2].
        radii: half sides in pixels [I, N, 2]; 0 for a splat that is not rendered.
        order: indices of the splats of all images [I * N], in the order of the result.
        rows: tile rows of an image that have pixels.
        columns: tile columns of an image.

    Returns:
        Number of tiles of each splat, index of the first tile, and number of tiles across [3, I * N].
    """
    out = radii.new_empty(3, len(order), dtype=torch.int32)
    start(boxed_rows, len(order), centers, radii, order, out, centers.shape[1], rows, columns)
    return out


def placed(
    ends: Tensor, boxes: Tensor, order: Tensor, every: Tensor, capacity: int, columns: int
) -> tuple[Tensor, Tensor]:
    """Kernel of the operator ``placed`` of :mod:`ghgs_lit.ops.intersections`.

    Args:
        ends: end of each splat's intersections [N].
        boxes: from :func:`boxed` [3, N].
        order: indices of the splats in ``ends`` and ``boxes`` [N].
        every: indices of all tiles; unused entries get the last one.
        capacity: number of entries.
        columns: tile columns of an image.

    Returns:
        The tile of each entry, in the dtype of ``every``, and its splat [capacity].
    """
    tile = every.new_empty(capacity)
    splat = boxes.new_empty(capacity)
    splats = len(order)
    numbers = (splats, splats.bit_length(), columns, len(every) - 1)
    start(placed_rows, capacity, ends, boxes, order, tile, splat, *numbers)
    return tile, splat
