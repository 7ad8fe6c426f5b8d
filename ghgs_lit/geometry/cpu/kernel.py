"""The plane sweep of one pixel after the other (see :mod:`ghgs_lit.geometry.photo_consistency`)."""

import math
from functools import cache

import numpy as np
from numba.core import types

from ghgs_lit.kernels import memory, simd
from ghgs_lit.kernels.compile import helper, kernel_for
from ghgs_lit.kernels.simd import EXP2_LIMIT, LANES

ZERO, HALF, ONE, THREE = (np.float32(x) for x in (0, 0.5, 1, 3))
# Unsigned: a signed index is compared with 0 at each access.
INSIDE, CHANNELS = np.uint64(3), np.uint64(4)

FLOATS = [types.Array(types.float32, dimensions, "C") for dimensions in range(6)]
MASKS, PAIRS = types.Array(types.boolean, 4, "C"), types.Array(types.boolean, 3, "C")
NUMBER = types.int64


@cache
def sweep_rows():
    """The compiled :func:`_sweep_rows`."""
    maps = (FLOATS[1], MASKS, FLOATS[4], FLOATS[4], FLOATS[5], FLOATS[4], PAIRS, FLOATS[1])
    return kernel_for(_sweep_rows, *maps, types.float32, FLOATS[5], *[NUMBER] * 4)


@helper
def _project(ray, shift, low, length, shares, height, width, pixels, rights, downs):
    """Where the points of a ray lie in an image: index among its pixels, and the way to the next pixels.

    What lies outside the image, behind it or nowhere (NaN) is put into its rim, where nothing is seen.
    """
    for s in range(len(shares)):
        depth = low + length * shares[s]
        z = ray[2] * depth + shift[2]
        x, y = (ray[0] * depth + shift[0]) / z - HALF, (ray[1] * depth + shift[1]) / z - HALF
        seen = (z > ZERO) & (x > -ONE) & (x < np.float32(width)) & (y > -ONE) & (y < np.float32(height))
        x, y = x if seen else -ONE, y if seen else -ONE
        left, top = np.floor(x), np.floor(y)
        rights[s], downs[s] = x - left, y - top
        pixels[s] = (np.int32(top) + np.int32(1)) * np.int32(width + 2) + np.int32(left) + np.int32(1)


@helper
def _compare(colors, own, at, line, right, down, columns):
    """Difference of pixel ``own`` and what lies between four pixels from ``at``; how much is seen there.

    A line's two pixels are loaded at once; ``columns`` holds their channels on the way down to the next line.
    """
    above, below = memory.load_anywhere(colors, at), memory.load_anywhere(colors, at + line)
    memory.store(columns, 0, simd.fma(below - above, down, above))
    difference = ZERO
    for channel in range(INSIDE):
        color = columns[channel] + right * (columns[channel + CHANNELS] - columns[channel])
        difference += abs(color - colors[own + channel])
    return difference, columns[INSIDE] + right * (columns[INSIDE + CHANNELS] - columns[INSIDE])


@helper
def _keep_best(best, differences, seen, rate):
    """``best = max(best, seen 2^(-rate difference))``."""
    for s in range(0, len(best), LANES):
        exponent = memory.load(differences, s) * simd.full(rate)
        agreement = memory.load(seen, s) * simd.exp2_minus(simd.minimum(simd.full(EXP2_LIMIT), exponent))
        memory.store(best, s, simd.maximum(memory.load(best, s), agreement))


def _sweep_rows(
    colors, masks, near, far, turn, shift, compared, shares, tolerance, out, element, view, first, last
):
    """Write rows ``first`` to ``last`` of ``out[element, view]``; see :func:`ghgs_lit.geometry.cpu.sweep`.

    The arithmetic of all depths of a pixel comes before their colours: without a branch, it is vectorized.
    """
    views, height, width = masks.shape[1], masks.shape[2], masks.shape[3]
    count = len(shares)
    line = np.uint64(width + 2) * CHANNELS
    size = np.uint64(height + 2) * line
    rate = np.float32(math.log2(math.e)) / (THREE * tolerance)
    padded = -(-count // LANES) * LANES
    pixels = np.empty(count, np.int64)
    rights, downs = np.empty(count, np.float32), np.empty(count, np.float32)
    differences, seen, best = simd.aligned(padded), simd.aligned(padded), simd.aligned(padded)
    columns = simd.aligned(LANES)
    differences[:], seen[:] = ZERO, ZERO  # no result, but defined arithmetic beyond the last depth
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
            best[:] = ZERO
            for other in range(views):
                if other == view or not compared[element, view, other]:
                    continue
                m, t = turn[element, view, other], shift[element, view, other]
                ray = (
                    m[0, 0] * u + m[0, 1] * v + m[0, 2],
                    m[1, 0] * u + m[1, 1] * v + m[1, 2],
                    m[2, 0] * u + m[2, 1] * v + m[2, 2],
                )
                moved = (t[0], t[1], t[2])
                _project(ray, moved, low, length, shares, height, width, pixels, rights, downs)
                start = np.uint64(element * views + other) * size
                for s in range(count):
                    at = start + np.uint64(pixels[s]) * CHANNELS
                    differences[s], seen[s] = _compare(colors, own, at, line, rights[s], downs[s], columns)
                _keep_best(best, differences, seen, rate)
            out[element, view, row, column] = best[:count]
