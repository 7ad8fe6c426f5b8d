"""Kernels that count the votes of the views about cells and about depths along rays."""

import numpy as np
from numba.core import types

from ghgs_lit.bounds.silhouettes import NEAREST
from ghgs_lit.kernels.compile import FLOATS, NUMBER, helper, kernel_for

ZERO, ONE, TWO, LEAST = np.float32(0), np.float32(1), np.float32(2), np.float32(NEAREST)


VOTES, MASKS = (types.Array(kind, 4, "C") for kind in (types.uint8, types.boolean))
_MAPS = (VOTES, MASKS, FLOATS[4], FLOATS[5], FLOATS[3], FLOATS[4], FLOATS[4], FLOATS[1])


@helper
def _vote(table, x, y, w):
    """Entry at a homogeneous pixel; see :func:`ghgs_lit.bounds.silhouettes.look_up`."""
    inverse = ONE / (LEAST if w < LEAST else w)
    column, row = x * inverse, y * inverse
    right, bottom = np.float32(table.shape[1] - 1), np.float32(table.shape[0] - 1)
    # Comparisons with NaN are false, so it becomes 0.
    column = (right if column > right else column) if column > ZERO else ZERO
    row = (bottom if row > bottom else row) if row > ZERO else ZERO
    # Unsigned: Numba checks the sign of a signed index.
    return table[np.uint64(np.int64(row)), np.uint64(np.int64(column))]


@kernel_for(VOTES, FLOATS[4], FLOATS[3], MASKS, *[NUMBER] * 4)
def carve_slices(outside, matrices, position, kept, tolerance, element, first, last):
    """Write slices ``first`` to ``last`` of ``kept[element]``; see :func:`ghgs_lit.bounds.cpu.carve`."""
    views, cells = outside.shape[1], position.shape[2]
    line = np.empty((views, 3), np.float32)
    for i in range(first, last):
        for j in range(cells):
            for v in range(views):
                for c in range(3):
                    matrix = matrices[element, v, c]
                    line[v, c] = matrix[0] * position[element, 0, i] + matrix[1] * position[element, 1, j]
            for k in range(cells):
                votes = 0
                for v in range(views):
                    matrix, z = matrices[element, v], position[element, 2, k]
                    x = line[v, 0] + (matrix[0, 2] * z + matrix[0, 3])
                    y = line[v, 1] + (matrix[1, 2] * z + matrix[1, 3])
                    w = line[v, 2] + (matrix[2, 2] * z + matrix[2, 3])
                    votes += _vote(outside[element, v], x, y, w)
                    if votes > tolerance:
                        break
                kept[element, i, j, k] = votes <= tolerance


@helper
def _allowed(outside, element, view, origin, along, depth, tolerance):
    """Whether at most ``tolerance`` other views place the point at ``depth`` outside."""
    votes = 0
    for u in range(len(origin)):
        if u != view:
            x = origin[u, 0] + depth * along[u, 0]
            y = origin[u, 1] + depth * along[u, 1]
            w = origin[u, 2] + depth * along[u, 2]
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
    """Narrow the bounds of rows ``first`` to ``last`` of a view; see :func:`ghgs_lit.bounds.cpu.march`."""
    views, width, samples = masks.shape[1], masks.shape[3], len(steps)
    origin, along = np.empty((views, 3), np.float32), np.empty((views, 3), np.float32)
    for u in range(views):
        for c in range(3):
            matrix = matrices[element, u, c]
            origin[u, c] = _product(matrix, centers[element, view]) + matrix[3]
    for row in range(first, last):
        for column in range(width):
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
                if _allowed(outside, element, view, origin, along, depth, tolerance):
                    break
                entry += 1
            if entry == samples:
                continue
            end = samples - 1
            while end > entry:
                depth = begin + steps[end] * length
                if _allowed(outside, element, view, origin, along, depth, tolerance):
                    break
                end -= 1
            near[element, view, row, column] = begin + steps[entry] * length - half
            far[element, view, row, column] = begin + steps[end] * length + half
