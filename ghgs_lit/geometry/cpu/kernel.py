"""The plane sweep of one pixel after the other (see :mod:`ghgs_lit.geometry.photo_consistency`)."""

import math
from functools import cache

import numpy as np
from numba.core import types

from ghgs_lit.kernels.compile import helper, kernel_for

ZERO, HALF, ONE, THREE = (np.float32(x) for x in (0, 0.5, 1, 3))
# Unsigned: a signed index is compared with 0 at each access.
RED, GREEN, BLUE, INSIDE, CHANNELS = (np.uint64(x) for x in range(5))

FLOATS = [types.Array(types.float32, dimensions, "C") for dimensions in range(6)]
MASKS, PAIRS = types.Array(types.boolean, 4, "C"), types.Array(types.boolean, 3, "C")
NUMBER = types.int64


@cache
def sweep_rows():
    """The compiled :func:`_sweep_rows`."""
    maps = (FLOATS[1], MASKS, FLOATS[4], FLOATS[4], FLOATS[5], FLOATS[4], PAIRS, FLOATS[1])
    return kernel_for(_sweep_rows, *maps, types.float32, FLOATS[5], *[NUMBER] * 4)


@helper
def _blend(values, at, below, down, right):
    """Bilinear value between four pixels: ``at`` and the next one, and those ``below`` floats behind them."""
    above = values[at] * (ONE - right) + values[at + CHANNELS] * right
    under = values[at + below] * (ONE - right) + values[at + below + CHANNELS] * right
    return above * (ONE - down) + under * down


@helper
def _agreement(colors, own, start, height, width, x, y, best, rate):
    """Agreement of pixel ``own`` with an image at the position (x, y) among its pixels, at least ``best``."""
    # Nothing is seen outside; NaN is outside, too.
    if not (x > -ONE and x < np.float32(width) and y > -ONE and y < np.float32(height)):
        return best
    left, top = np.float32(math.floor(x)), np.float32(math.floor(y))
    right, down = x - left, y - top
    line = np.uint64(width + 2) * CHANNELS
    at = start + np.uint64(np.int64(top) + 1) * line + np.uint64(np.int64(left) + 1) * CHANNELS
    seen = _blend(colors, at + INSIDE, line, down, right)
    # The agreement is no larger than the share of the subject.
    if seen <= best:
        return best
    difference = abs(_blend(colors, at + RED, line, down, right) - colors[own + RED])
    difference += abs(_blend(colors, at + GREEN, line, down, right) - colors[own + GREEN])
    difference += abs(_blend(colors, at + BLUE, line, down, right) - colors[own + BLUE])
    found = np.exp(-difference * rate) * seen
    return found if found > best else best


def _sweep_rows(
    colors, masks, near, far, turn, shift, compared, shares, tolerance, out, element, view, first, last
):
    """Write rows ``first`` to ``last`` of ``out[element, view]``; see :func:`ghgs_lit.geometry.cpu.sweep`."""
    views, height, width = masks.shape[1], masks.shape[2], masks.shape[3]
    count = len(shares)
    size = np.uint64((height + 2) * (width + 2)) * CHANNELS
    rate = ONE / (THREE * tolerance)
    for row in range(first, last):
        v = np.float32(row) + HALF
        for column in range(width):
            if not masks[element, view, row, column]:
                continue
            u = np.float32(column) + HALF
            place = np.uint64((row + 1) * (width + 2) + column + 1) * CHANNELS
            own = np.uint64(element * views + view) * size + place
            low = near[element, view, row, column]
            length = far[element, view, row, column] - low
            for other in range(views):
                if other == view or not compared[element, view, other]:
                    continue
                m, t = turn[element, view, other], shift[element, view, other]
                rx = m[0, 0] * u + m[0, 1] * v + m[0, 2]
                ry = m[1, 0] * u + m[1, 1] * v + m[1, 2]
                rz = m[2, 0] * u + m[2, 1] * v + m[2, 2]
                start = np.uint64(element * views + other) * size
                for s in range(count):
                    depth = low + length * shares[s]
                    z = rz * depth + t[2]
                    if z > ZERO:
                        x, y = (rx * depth + t[0]) / z - HALF, (ry * depth + t[1]) / z - HALF
                        best = out[element, view, row, column, s]
                        out[element, view, row, column, s] = _agreement(
                            colors, own, start, height, width, x, y, best, rate
                        )
