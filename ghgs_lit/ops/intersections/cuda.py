"""Which splats each tile draws, for a GPU, in Triton;
see :mod:`ghgs_lit.ops.intersections`."""

import torch
import triton
import triton.language as tl
from torch import Tensor

from ghgs_lit.ops.tiles import rows_of, start

TILE = tl.constexpr(16)


@triton.jit
def ends_of(center, radius, limit):
    """First and last tile of a splat along one side of an image.

    Args:
        center: in pixels.
        radius: half side of its box in pixels.
        limit: number of tiles along this side.

    Returns:
        The first tile, and the one after the last, from 0 to ``limit``.
    """
    reach = radius.to(tl.float32) / TILE
    middle = center / TILE
    most = limit + 0.0  # a single tile is a constant of the compiler
    begin = tl.minimum(tl.maximum(tl.floor(middle - reach), 0.0), most)
    end = tl.minimum(tl.maximum(tl.ceil(middle + reach), 0.0), most)
    return begin.to(tl.int32), end.to(tl.int32)


@triton.jit
def boxed_rows(count, centers, radii, order, out, per_image, rows, columns, ROWS: tl.constexpr):
    """Write the tiles of ``ROWS`` splats; see :func:`boxed`.

    Args:
        count: number of splats of all images, N.
        centers: [N, 2] in pixels.
        radii: [N, 2], half sides in pixels; 0 where a splat is not drawn.
        order: [N], splats in the order of the rows that are written.
        out: [3, N], written: numbers of tiles, the first one, and the number across.
        per_image: splats of an image.
        rows: of tiles that have pixels, in one image.
        columns: of tiles in one image.
        ROWS: splats of a program.
    """
    i = rows_of(count, ROWS)
    splat = tl.load(order + i)
    across = tl.load(radii + 2 * splat)
    down = tl.load(radii + 2 * splat + 1)
    is_drawn = (across > 0) & (down > 0)
    # What is not drawn may have a centre that is not finite.
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
    """Write what ``ROWS`` places hold; see :func:`placed`.

    Args:
        count: number of places.
        ends: [N], places up to the end of each splat's, ascending.
        boxes: [3, N], as written by :func:`boxed_rows`.
        order: [N], the splats of the rows of ``ends`` and ``boxes``.
        tile: [count], written: the tile of each place.
        splat: [count], written: the splat of each place.
        splats: N.
        steps: of a search among the splats.
        columns: of tiles in one image.
        last: tile of places that no splat needs.
        ROWS: places of a program.
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
    """The operator of :mod:`ghgs_lit.ops.intersections`.

    Args:
        centers: of splats in pixels [I, N, 2].
        radii: half sides in pixels [I, N, 2]; 0 where a splat is not drawn.
        order: splats of all images [I * N], in the order of the result.
        rows: of tiles that have pixels, in one image.
        columns: of tiles in one image.

    Returns:
        Number of each splat's tiles, index of the first one, and the number across [3, I * N].
    """
    out = radii.new_empty(3, len(order), dtype=torch.int32)
    start(boxed_rows, len(order), centers, radii, order, out, centers.shape[1], rows, columns)
    return out


def placed(
    ends: Tensor, boxes: Tensor, order: Tensor, every: Tensor, capacity: int, columns: int
) -> tuple[Tensor, Tensor]:
    """The operator of :mod:`ghgs_lit.ops.intersections`.

    Args:
        ends: places up to the end of each splat's [N].
        boxes: as of :func:`boxed` [3, N].
        order: splats of the rows of ``ends`` and ``boxes`` [N].
        every: numbers of all tiles; places that no splat needs are of the last one.
        capacity: number of places.
        columns: of tiles in one image.

    Returns:
        The tile of each place, in the type of ``every``, and its splat [capacity].
    """
    tile = every.new_empty(capacity)
    splat = boxes.new_empty(capacity)
    splats = len(order)
    numbers = (splats, splats.bit_length(), columns, len(every) - 1)
    start(placed_rows, capacity, ends, boxes, order, tile, splat, *numbers)
    return tile, splat
