"""Searches of the bounds for a GPU, in Triton: formulas of :mod:`ghgs_lit.method.bounds.rays`, ``box`` and
``hull``. ``outside``: 1 where a view says "outside"."""

import torch
import triton
import triton.language as tl
from torch import Tensor

from ghgs_lit.kernels.tiles import load3, load4, rows_of, start
from ghgs_lit.method.bounds.rays import NEAREST

LEAST = tl.constexpr(NEAREST)


@triton.jit
def _cell(x, inverse, size):
    """The index along an axis of the cell at a homogeneous place, or of the nearest one;
    0 for NaN."""
    place = x * inverse
    place = tl.where(place > 0, place, 0.0)
    return tl.where(place < size - 1, place, size - 1).to(tl.int32)


@triton.jit
def _vote(outside, view, x, y, w, height, width):
    """Entries of tables at homogeneous pixels;
    outside the frame, those of the nearest border pixel.

    Args:
        outside: tables [images, height, width] of uint8.
        view: number of the table of each row.
        x: first homogeneous coordinate; x / w is the column, with pixel centres at +0.5.
        y: second; y / w is the row.
        w: third, the depth in metres.
        height: of a table.
        width: of a table.
    """
    inverse = 1 / tl.where(w > LEAST, w, LEAST)
    row = _cell(y, inverse, height)
    column = _cell(x, inverse, width)
    return tl.load(outside + (view * height + row) * width + column).to(tl.int32)


@triton.jit
def dilated_rows(
    count, masks, more, out, radius, area, size, stride, HAS_MORE: tl.constexpr, ROWS: tl.constexpr
):
    """Write ``ROWS`` pixels of masks that are grown along one axis.

    Args:
        count: number of pixels of all masks.
        masks: bool.
        more: [B], pixels by which the masks of each element grow more; read with ``HAS_MORE``.
        out: bool, written; of the masks' shape.
        radius: pixels by which all masks grow.
        area: pixels of an element, of all its views.
        size: pixels along the axis.
        stride: distance of its neighbouring pixels in memory.
        HAS_MORE: whether there is ``more``.
        ROWS: pixels of a program.
    """
    i = rows_of(count, ROWS)
    place = i // stride % size
    reach = tl.zeros_like(place).to(tl.int32) + radius
    if HAS_MORE:
        reach += tl.load(more + i // area)
    reach = tl.minimum(reach, size)
    grown = tl.load(masks + i).to(tl.int32)
    for step in range(1, tl.max(reach, 0) + 1):
        is_near = step <= reach
        after = is_near & (place + step < size)
        before = is_near & (place >= step)
        grown |= tl.load(masks + i + step * stride, after, 0).to(tl.int32)
        grown |= tl.load(masks + i - step * stride, before, 0).to(tl.int32)
    tl.store(out + i, grown != 0)


@triton.jit
def carved_rows(
    count, outside, matrices, position, kept, views, cells, height, width, tolerance, ROWS: tl.constexpr
):
    """Write ``ROWS`` cells of the grids of all elements.

    Args:
        count: number of cells, B n^3.
        outside: [B, V, height, width].
        matrices: [B, V, 3, 4], of projection.
        position: [B, 3, n], centres of the cells along each axis, in metres.
        kept: bool [B, n, n, n], written.
        views: V.
        cells: n.
        height: of ``outside``.
        width: of ``outside``.
        tolerance: votes that a kept cell may have.
        ROWS: cells of a program.
    """
    i = rows_of(count, ROWS)
    element = i // cells // cells // cells
    at = position + element * 3 * cells
    x = tl.load(at + i // cells // cells % cells)
    y = tl.load(at + cells + i // cells % cells)
    z = tl.load(at + 2 * cells + i % cells)
    votes = tl.zeros_like(i).to(tl.int32)
    for v in range(views):
        view = element * views + v
        a, b, c, d = load4(matrices, 3 * view)
        e, f, g, h = load4(matrices, 3 * view + 1)
        k, m, n, o = load4(matrices, 3 * view + 2)
        right = a * x + b * y + (c * z + d)
        below = e * x + f * y + (g * z + h)
        votes += _vote(outside, view, right, below, k * x + m * y + (n * z + o), height, width)
    tl.store(kept + i, votes <= tolerance)


@triton.jit
def marched_rows(
    count, outside, masks, matrices, directions, centers, near, far, new_near, new_far,
    samples, views, height, width, tolerance, ROWS: tl.constexpr,
):  # fmt: skip
    """Write the bounds of ``ROWS`` rays, one for each pixel of a mask; those of others are copied.

    Args:
        count: number of pixels, B V height width.
        outside: [B, V, height, width].
        masks: bool [B, V, height, width], the subject's pixels.
        matrices: [B, V, 3, 4], of projection.
        directions: [B, V, height, width, 3], of the rays, per metre of depth.
        centers: [B, V, 3], of the cameras, in metres.
        near: [B, V, height, width], the depth in metres from which others are tried.
        far: the depth to which they are.
        new_near: written, of the shape of ``near``.
        new_far: written.
        samples: number of depths that are tried.
        views: V.
        height: of the masks.
        width: of the masks.
        tolerance: votes that an allowed depth may have.
        ROWS: rays of a program.
    """
    i = rows_of(count, ROWS)
    image = i // (height * width)
    begin = tl.load(near + i)
    end = tl.load(far + i)
    length = end - begin
    x, y, z = load3(directions, i)
    cx, cy, cz = load3(centers, image)
    first = tl.zeros_like(i).to(tl.int32) + samples
    last = tl.zeros_like(i).to(tl.int32) - 1
    for step in range(samples):
        depth = begin + (step + 0.5) / samples * length
        votes = tl.zeros_like(first)
        for other in range(1, views):
            view = image // views * views + (image + other) % views
            a, b, c, d = load4(matrices, 3 * view)
            e, f, g, h = load4(matrices, 3 * view + 1)
            k, m, n, o = load4(matrices, 3 * view + 2)
            right = (a * cx + b * cy + c * cz + d) + depth * (a * x + b * y + c * z)
            below = (e * cx + f * cy + g * cz + h) + depth * (e * x + f * y + g * z)
            front = (k * cx + m * cy + n * cz + o) + depth * (k * x + m * y + n * z)
            votes += _vote(outside, view, right, below, front, height, width)
        is_allowed = votes <= tolerance
        first = tl.where(is_allowed & (first == samples), step, first)
        last = tl.where(is_allowed, step, last)
    is_hit = (first < samples) & (tl.load(masks + i) != 0)
    half = length / (2 * samples)
    bound = begin + (first + 0.5) / samples * length - half
    tl.store(new_near + i, tl.where(is_hit, bound, begin))
    bound = begin + (last + 0.5) / samples * length + half
    tl.store(new_far + i, tl.where(is_hit, bound, end))


def dilated(masks: Tensor, radius: int, more: Tensor | None, axis: int) -> Tensor:
    """The operator of :mod:`ghgs_lit.method.bounds.rays`.

    Args:
        masks: bool [..., h, w], of elements along the first dimension.
        radius: pixels by which they grow.
        more: [B], further ones of each element; None: none.
        axis: -2 or -1.

    Returns:
        Masks of the same shape.
    """
    height, width = masks.shape[-2:]
    out = masks.new_empty(masks.shape)
    size, stride = (height, width) if axis == -2 else (width, 1)
    given = (masks, more, out, radius, masks[0].numel() if len(masks) else 0, size, stride)
    start(dilated_rows, masks.numel(), *given, HAS_MORE=more is not None)
    return out


def carved(outside: Tensor, matrices: Tensor, position: Tensor, tolerance: int) -> Tensor:
    """The operator of :mod:`ghgs_lit.method.bounds.box`.

    Args:
        outside: uint8 [B, V, h, w], 1 where a view says "outside".
        matrices: [B, V, 3, 4], of projection.
        position: [B, 3, n], centres of the cells along each axis, in metres.
        tolerance: votes that a kept cell may have.

    Returns:
        The kept cells, bool [B, n, n, n].
    """
    _, views, height, width = outside.shape
    cells = position.shape[2]
    kept = outside.new_empty(len(outside), cells, cells, cells, dtype=torch.bool)
    given = (outside, matrices, position, kept, views, cells, height, width, tolerance)
    start(carved_rows, kept.numel(), *given)
    return kept


def marched(*inputs) -> tuple[Tensor, Tensor]:
    """The operator of :mod:`ghgs_lit.method.bounds.hull`."""
    *tensors, samples, tolerance = inputs
    _, views, height, width = tensors[0].shape
    near, far = (x.new_empty(x.shape) for x in tensors[-2:])
    start(marched_rows, near.numel(), *tensors, near, far, samples, views, height, width, tolerance)
    return near, far
