"""Functions shared by the Triton kernels; a tile holds one number per row.

Import it only from kernels: Triton comes with PyTorch for CUDA only."""

from typing import Any

import triton
import triton.language as tl
from torch import Tensor

#: Rows of a program.
ROWS = 128


def start(kernel: Any, count: int, *arguments: Any, **flags: bool) -> None:
    """Launch ``kernel(count, *arguments, **flags, ROWS=ROWS)`` with contiguous tensors.

    Args:
        kernel: a ``triton.jit`` function.
        count: number of rows; nothing is launched for 0.
        arguments: tensors and numbers; tensors are made contiguous.
        flags: compile-time constants.
    """
    if count > 0:
        read = [x.contiguous() if isinstance(x, Tensor) else x for x in arguments]
        kernel[(triton.cdiv(count, ROWS),)](count, *read, **flags, ROWS=ROWS)


@triton.jit
def rows_of(count, ROWS: tl.constexpr):
    """Indices of the rows of this program, int64 [ROWS]; the last row repeats, so that no mask is needed.

    Args:
        count: number of rows.
        ROWS: rows per program.
    """
    i = tl.program_id(0).to(tl.int64) * ROWS + tl.arange(0, ROWS)
    return tl.minimum(i, count - 1)


@triton.jit
def load3(table, i):
    """Load rows ``i`` [ROWS] of a contiguous table [rows, 3] as three columns, [ROWS] each."""
    return tl.load(table + 3 * i), tl.load(table + 3 * i + 1), tl.load(table + 3 * i + 2)


@triton.jit
def store3(table, i, x, y, z):
    """Write three columns, [ROWS] each, to rows ``i`` [ROWS] of a contiguous table [rows, 3]."""
    tl.store(table + 3 * i, x)
    tl.store(table + 3 * i + 1, y)
    tl.store(table + 3 * i + 2, z)


@triton.jit
def load4(table, i):
    """Load rows ``i`` [ROWS] of a contiguous table [rows, 4] as four columns, [ROWS] each."""
    at = table + 4 * i
    return tl.load(at), tl.load(at + 1), tl.load(at + 2), tl.load(at + 3)


@triton.jit
def store4(table, i, w, x, y, z):
    """Write four columns, [ROWS] each, to rows ``i`` [ROWS] of a contiguous table [rows, 4]."""
    tl.store(table + 4 * i, w)
    tl.store(table + 4 * i + 1, x)
    tl.store(table + 4 * i + 2, y)
    tl.store(table + 4 * i + 3, z)


@triton.jit
def clamp(x, low, high):
    """Clamp ``x`` [ROWS] to two limits; NaN stays NaN."""
    return tl.where(x > high, high, tl.where(x < low, low, x))


@triton.jit
def tanh(x):
    """Hyperbolic tangent; near 0 by a series, since the quotient loses digits there."""
    shrunk = tl.exp(-2 * tl.abs(x))
    size = (1 - shrunk) / (1 + shrunk)
    squared = x * x
    series = x * (1 + squared * (-1 / 3 + squared * (2 / 15 - squared * (17 / 315))))
    return tl.where(tl.abs(x) < 0.2, series, tl.where(x < 0, -size, size))


@triton.jit
def to_camera(extrinsics, view, x, y, z):
    """Transform world points to the axes of their cameras.

    Args:
        extrinsics: pointer to world-to-camera matrices [V, 4, 4].
        view: index of each point's camera, [ROWS].
        x: world coordinates, [ROWS].
        y: world coordinates, [ROWS].
        z: world coordinates, [ROWS].

    Returns:
        Camera coordinates to the right, down and forward, [ROWS] each.
    """
    a, b, c, shift = load4(extrinsics, 4 * view)
    right = a * x + b * y + c * z + shift
    a, b, c, shift = load4(extrinsics, 4 * view + 1)
    below = a * x + b * y + c * z + shift
    a, b, c, shift = load4(extrinsics, 4 * view + 2)
    return right, below, a * x + b * y + c * z + shift


@triton.jit
def cells(place, size):
    """Find the two cells around a position along an axis of a map, for linear interpolation.

    Args:
        place: position in cells from the map's border, with cell centres at +0.5, [ROWS].
        size: number of cells along the axis.

    Returns:
        Indices of both cells, clamped to the map, and their weights, which are 0 outside the map, for
        NaN and for distant positions.
    """
    place = tl.where(place > -2, tl.where(place < size + 2, place, size + 2), -2) - 0.5
    first = tl.floor(place)
    share = place - first
    at = first.to(tl.int32)
    before = tl.where((at >= 0) & (at < size), 1 - share, 0.0)
    after = tl.where((at >= -1) & (at < size - 1), share, 0.0)
    left = tl.maximum(tl.minimum(at, size - 1), 0)
    right = tl.maximum(tl.minimum(at + 1, size - 1), 0)
    return left, right, before, after


@triton.jit
def between(plane, top, bottom, left, right, above, below, before, after):
    """Interpolate a map bilinearly between two rows and two columns.

    Args:
        plane: pointer to one channel of a map.
        top: offset of the upper row in the plane.
        bottom: offset of the lower row in the plane.
        left: the left column.
        right: the right column.
        above: weight of the upper row.
        below: weight of the lower row.
        before: weight of the left column.
        after: weight of the right column.
    """
    upper = before * tl.load(plane + top + left) + after * tl.load(plane + top + right)
    lower = before * tl.load(plane + bottom + left) + after * tl.load(plane + bottom + right)
    return above * upper + below * lower
