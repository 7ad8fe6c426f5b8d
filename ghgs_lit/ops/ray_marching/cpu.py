"""CPU kernel of the search along rays.

The arithmetic is that of the plain version, so that results agree bitwise on processors with fused
multiply-add."""

import numpy as np
import torch
from numba.core import types
from torch import Tensor

from ghgs_lit.ops import pool
from ghgs_lit.ops.compile import FLOATS, NUMBER, helper, kernel_for
from ghgs_lit.ops.ray_marching import NEAREST

#: Rows of an image in one task.
_ROWS = 16
ZERO = np.float32(0)
ONE = np.float32(1)
TWO = np.float32(2)
LEAST = np.float32(NEAREST)
VOTES = types.Array(types.uint8, 4, "C")
MASKS = types.Array(types.boolean, 4, "C")
_MAPS = (VOTES, MASKS, FLOATS[4], FLOATS[5], FLOATS[3], FLOATS[4], FLOATS[4], FLOATS[1])


@helper
def _vote(table, x, y, w):
    """Entry of a view's table at the homogeneous pixel (x, y, w); see
    :func:`ghgs_lit.ops.ray_marching.look_up`."""
    inverse = ONE / (LEAST if w < LEAST else w)
    column = x * inverse
    row = y * inverse
    right = np.float32(table.shape[1] - 1)
    bottom = np.float32(table.shape[0] - 1)
    # Comparisons with NaN are false, so NaN becomes 0.
    column = (right if column > right else column) if column > ZERO else ZERO
    row = (bottom if row > bottom else row) if row > ZERO else ZERO
    # Unsigned: Numba checks the sign of a signed index.
    return table[np.uint64(np.int64(row)), np.uint64(np.int64(column))]


@helper
def _multiply_add(start, length, slope):
    """``start + length * slope`` of float32 numbers, rounded once like ``torch.addcmul`` on processors with
    fused multiply-add."""
    return np.float32(np.float64(start) + np.float64(length) * np.float64(slope))


@helper
def _is_allowed(outside, element, view, origin, along, depth, tolerance):
    """Whether at most ``tolerance`` other views vote "outside" for a point of a ray.

    Args:
        outside: votes of all views.
        element: batch element.
        view: view of the ray, which does not vote.
        origin: homogeneous pixels of the ray's camera centre in all views [V, 3].
        along: change of these pixels per metre of depth [V, 3].
        depth: depth of the point in metres.
        tolerance: largest number of votes against an allowed depth.
    """
    votes = 0
    for u in range(len(origin)):
        if u != view:
            x = _multiply_add(origin[u, 0], depth, along[u, 0])
            y = _multiply_add(origin[u, 1], depth, along[u, 1])
            w = _multiply_add(origin[u, 2], depth, along[u, 2])
            votes += _vote(outside[element, u], x, y, w)
            if votes > tolerance:
                return False
    return True


@helper
def _product(row, vector):
    return row[0] * vector[0] + row[1] * vector[1] + row[2] * vector[2]


@kernel_for(*_MAPS, *[NUMBER] * 5)
def march_rows(
    outside, masks, matrices, directions, centers, near, far, steps, tolerance, element, view, first, last
):
    """Narrow the bounds of some rows of a view; see :func:`march`.

    Args:
        outside: votes of all views [B, V, h, w].
        masks: foreground pixels [B, V, h, w].
        matrices: projection matrices [B, V, 3, 4].
        directions: directions of rays [B, V, h, w, 3].
        centers: camera centres [B, V, 3].
        near: near bounds in metres [B, V, h, w]; overwritten.
        far: far bounds in metres [B, V, h, w]; overwritten.
        steps: sampled depths as fractions of the interval from near to far.
        tolerance: largest number of votes against an allowed depth.
        element: batch element.
        view: view of the rows.
        first: first row.
        last: end of the rows, excluded.
    """
    views = masks.shape[1]
    samples = len(steps)
    origin = np.empty((views, 3), np.float32)
    along = np.empty((views, 3), np.float32)
    for u in range(views):
        for c in range(3):
            matrix = matrices[element, u, c]
            origin[u, c] = _product(matrix, centers[element, view]) + matrix[3]
    for row in range(first, last):
        for column in range(masks.shape[3]):
            if not masks[element, view, row, column]:
                continue
            direction = directions[element, view, row, column]
            for u in range(views):
                for c in range(3):
                    along[u, c] = _product(matrices[element, u, c], direction)
            begin = near[element, view, row, column]
            length = far[element, view, row, column] - begin
            half = length / (TWO * np.float32(samples))
            entry = 0
            while entry < samples:
                depth = begin + steps[entry] * length
                if _is_allowed(outside, element, view, origin, along, depth, tolerance):
                    break
                entry += 1
            if entry == samples:
                continue
            end = samples - 1
            while end > entry:
                depth = begin + steps[end] * length
                if _is_allowed(outside, element, view, origin, along, depth, tolerance):
                    break
                end -= 1
            near[element, view, row, column] = begin + steps[entry] * length - half
            far[element, view, row, column] = begin + steps[end] * length + half


def march(
    masks: Tensor,
    outside: Tensor,
    matrices: Tensor,
    directions: Tensor,
    centers: Tensor,
    near: Tensor,
    far: Tensor,
    steps: Tensor,
    tolerance: int,
    rays: Tensor | None,
    count: int | None,
) -> tuple[Tensor, Tensor]:
    """Kernel of the operator of :mod:`ghgs_lit.ops.ray_marching`; ``rays`` and ``count`` are unused."""
    elements, views, height, _ = masks.shape
    near, far = (bound.clone(memory_format=torch.contiguous_format) for bound in (near, far))
    tables = (outside, masks, matrices, directions, centers, near, far, steps)
    arrays = [table.detach().contiguous().numpy() for table in tables]
    ranges = [(image // views, image % views, 0, height) for image in range(elements * views)]
    pool.run_rows(march_rows(), (*arrays, tolerance), ranges, _ROWS, masks.numel())
    return near, far
