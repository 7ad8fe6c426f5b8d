"""What kernels in Triton share: functions of tiles, which hold one number for each row. Only
kernels import it, since no other PyTorch than CUDA's comes with Triton."""

from typing import Any

import triton
import triton.language as tl
from torch import Tensor

#: Rows of a program.
ROWS = 128


def start(kernel: Any, count: int, *arguments: Any, **flags: bool) -> None:
    """Start a kernel with contiguous tensors: ``kernel(count, *arguments, **flags, ROWS=ROWS)``.

    Args:
        kernel: a function of Triton.
        count: number of rows; with 0 nothing is started.
        arguments: tensors and numbers.
        flags: constants of the compiler.
    """
    if count > 0:
        read = [x.contiguous() if isinstance(x, Tensor) else x for x in arguments]
        kernel[(triton.cdiv(count, ROWS),)](count, *read, **flags, ROWS=ROWS)


@triton.jit
def rows_of(count, ROWS: tl.constexpr):
    """Rows of this program; beyond the last one it is repeated, so that no row need be masked.

    Args:
        count: number of rows.
        ROWS: rows of a program.

    Returns:
        Numbers of rows, int64 [ROWS].
    """
    i = tl.program_id(0).to(tl.int64) * ROWS + tl.arange(0, ROWS)
    return tl.minimum(i, count - 1)


@triton.jit
def load3(table, i):
    """Numbers of rows of a table of three columns.

    Args:
        table: pointer to a contiguous table [rows, 3].
        i: rows, [ROWS].

    Returns:
        The columns, [ROWS] each.
    """
    return tl.load(table + 3 * i), tl.load(table + 3 * i + 1), tl.load(table + 3 * i + 2)


@triton.jit
def store3(table, i, x, y, z):
    """Write rows of a table of three columns.

    Args:
        table: pointer to a contiguous table [rows, 3].
        i: rows, [ROWS].
        x: first column, [ROWS].
        y: second column, [ROWS].
        z: third column, [ROWS].
    """
    tl.store(table + 3 * i, x)
    tl.store(table + 3 * i + 1, y)
    tl.store(table + 3 * i + 2, z)


@triton.jit
def load4(table, i):
    """Numbers of rows of a table of four columns.

    Args:
        table: pointer to a contiguous table [rows, 4].
        i: rows, [ROWS].

    Returns:
        The columns, [ROWS] each.
    """
    at = table + 4 * i
    return tl.load(at), tl.load(at + 1), tl.load(at + 2), tl.load(at + 3)


@triton.jit
def store4(table, i, w, x, y, z):
    """Write rows of a table of four columns.

    Args:
        table: pointer to a contiguous table [rows, 4].
        i: rows, [ROWS].
        w: first column, [ROWS].
        x: second column, [ROWS].
        y: third column, [ROWS].
        z: fourth column, [ROWS].
    """
    tl.store(table + 4 * i, w)
    tl.store(table + 4 * i + 1, x)
    tl.store(table + 4 * i + 2, y)
    tl.store(table + 4 * i + 3, z)


@triton.jit
def clamp(x, low, high):
    """``x`` between two limits; NaN stays.

    Args:
        x: [ROWS].
        low: lower limit.
        high: upper limit.
    """
    return tl.where(x > high, high, tl.where(x < low, low, x))


@triton.jit
def tanh(x):
    """The hyperbolic tangent. Near 0 a series: the quotient loses digits there."""
    shrunk = tl.exp(-2 * tl.abs(x))
    size = (1 - shrunk) / (1 + shrunk)
    squared = x * x
    series = x * (1 + squared * (-1 / 3 + squared * (2 / 15 - squared * (17 / 315))))
    return tl.where(tl.abs(x) < 0.2, series, tl.where(x < 0, -size, size))


@triton.jit
def to_camera(extrinsics, view, x, y, z):
    """World points in axes of their cameras.

    Args:
        extrinsics: pointer to world-to-camera matrices [V, 4, 4].
        view: camera of each point, [ROWS].
        x: of the points in the world, [ROWS].
        y: of the points in the world, [ROWS].
        z: of the points in the world, [ROWS].

    Returns:
        Coordinates to the right, down and ahead of the camera, [ROWS] each.
    """
    a, b, c, shift = load4(extrinsics, 4 * view)
    right = a * x + b * y + c * z + shift
    a, b, c, shift = load4(extrinsics, 4 * view + 1)
    below = a * x + b * y + c * z + shift
    a, b, c, shift = load4(extrinsics, 4 * view + 2)
    return right, below, a * x + b * y + c * z + shift


@triton.jit
def cells(place, size):
    """The two cells around a place along an axis of a map, and their weights.

    Args:
        place: in cells from the map's border, centres of cells at +0.5, [ROWS].
        size: cells along the axis.

    Returns:
        Indices of both cells, clamped to the map, and their weights: 0 beyond its border. NaN, and
        places far away, are beyond it.
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
    """Bilinear value of a map between two rows and two columns.

    Args:
        plane: pointer to one channel of a map.
        top: where the upper row begins in the plane.
        bottom: where the lower row begins in the plane.
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
