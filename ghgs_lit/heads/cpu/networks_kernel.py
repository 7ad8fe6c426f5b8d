"""Networks of three layers of ``PANEL`` rows at once, and their gradients; see ``kernels.layers``."""

from functools import cache

from numba.core import types

from ghgs_lit.kernels import memory, simd
from ghgs_lit.kernels.compile import helper, kernel_for
from ghgs_lit.kernels.layers import (
    ZERO,
    bend,
    learn,
    linear,
    lines,
    put_ones,
    put_rows,
    put_slopes,
    rectify,
    size,
    unbend,
    unrectify,
)
from ghgs_lit.kernels.simd import LANES
from ghgs_lit.kernels.tile import PANEL

TABLE, FLAT = types.Array(types.float32, 2, "C"), types.Array(types.float32, 1, "C")
WIDTHS, FLAGS = types.Array(types.int64, 1, "C"), types.Array(types.boolean, 1, "C")
PLACES = types.Array(types.int64, 2, "C")


@cache
def attributes():
    """The compiled :func:`_attributes`."""
    return kernel_for(_attributes, TABLE, FLAT, WIDTHS, FLAGS, TABLE, types.int64, types.int64)


@cache
def attributes_back():
    """The compiled :func:`_attributes_back`."""
    layers = [FLAT, FLAT, PLACES, WIDTHS, FLAGS, FLAT]
    return kernel_for(_attributes_back, TABLE, TABLE, *layers, TABLE, types.int64, types.int64)


@helper
def _activate(bends, layers, at, outputs, inputs, values):
    """Add biases; then tanh where ``bends``, else ReLU."""
    if bends:
        bend(layers, at, outputs, inputs, values)
    else:
        rectify(layers, at, outputs, inputs, values)


def _attributes(descriptors, layers, widths, bends, out, first, last):
    """Write rows ``first`` to ``last``; see :func:`ghgs_lit.heads.cpu.attributes`."""
    channels, wide, narrow = descriptors.shape[1], widths[0], widths[1]
    widest = max(channels, lines(wide), lines(narrow), lines(widths[2:].max())) * PANEL
    given, one, two = simd.aligned(channels * PANEL), simd.aligned(widest), simd.aligned(widest)
    for start in range(first, last, PANEL):
        count = min(PANEL, last - start)
        put_rows(descriptors, start, count, 0, given)
        at, column = 0, 0
        for network in range(len(bends)):
            outputs = widths[2 + network]
            linear(layers, at, wide, channels, given, one)
            _activate(bends[network], layers, at, wide, channels, one)
            at += size(wide, channels)
            linear(layers, at, narrow, wide, one, two)
            _activate(bends[network], layers, at, narrow, wide, two)
            at += size(narrow, wide)
            linear(layers, at, outputs, narrow, two, one)
            biases = at + lines(outputs) * narrow
            for lane in range(count):
                for k in range(outputs):
                    out[start + lane, column + k] = one[k * PANEL + lane] + layers[biases + k]
            at += size(outputs, narrow)
            column += outputs


@helper
def _deactivate(bends, values, channels, slopes):
    """Slopes before the activation that gave ``values``."""
    if bends:
        unbend(values, channels, slopes)
    else:
        unrectify(values, channels, slopes)


def _attributes_back(
    descriptors, slopes, layers, backs, places, widths, bends, sums, d_descriptors, first, last
):
    """Write ``d_descriptors`` of rows, add up ``sums``; values inside are computed again, in the cache."""
    channels, wide, narrow = descriptors.shape[1], widths[0], widths[1]
    most = lines(max(channels, wide, narrow, widths[2:].max()) + 1) * PANEL
    given, one, two = simd.aligned(most), simd.aligned(most), simd.aligned(most)
    up, down, total = simd.aligned(most), simd.aligned(most), simd.aligned(most)
    turned = simd.aligned(most + PANEL * PANEL)
    for buffer in (given, one, two, turned):  # rows that no gradient is read of stay finite
        buffer[:] = ZERO
    for start in range(first, last, PANEL):
        count = min(PANEL, last - start)
        put_rows(descriptors, start, count, 0, given)
        put_ones(channels, given)
        total[:] = ZERO
        column = 0
        for network in range(len(bends)):
            outputs, bent = widths[2 + network], bends[network]
            place = places[3 * network : 3 * network + 3]
            linear(layers, place[0, 0], wide, channels, given, one)
            _activate(bent, layers, place[0, 0], wide, channels, one)
            put_ones(wide, one)
            linear(layers, place[1, 0], narrow, wide, one, two)
            _activate(bent, layers, place[1, 0], narrow, wide, two)
            put_ones(narrow, two)
            put_slopes(slopes, start, count, column, outputs, up)
            learn(two, narrow, up, outputs, turned, place[2, 2], sums)
            linear(backs, place[2, 1], narrow, outputs, up, down)
            _deactivate(bent, two, narrow, down)
            learn(one, wide, down, narrow, turned, place[1, 2], sums)
            linear(backs, place[1, 1], wide, narrow, down, up)
            _deactivate(bent, one, wide, up)
            learn(given, channels, up, wide, turned, place[0, 2], sums)
            linear(backs, place[0, 1], channels, wide, up, down)
            for i in range(0, channels * PANEL, LANES):
                memory.store(total, i, memory.load(total, i) + memory.load(down, i))
            column += outputs
        for lane in range(count):
            for channel in range(channels):
                d_descriptors[start + lane, channel] = total[channel * PANEL + lane]
