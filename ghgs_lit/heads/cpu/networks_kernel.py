"""Networks of three layers of ``PANEL`` rows at once (see :mod:`ghgs_lit.kernels.layers`)."""

from functools import cache

from numba.core import types

from ghgs_lit.kernels import simd
from ghgs_lit.kernels.compile import helper, kernel_for
from ghgs_lit.kernels.layers import bend, linear, lines, put_rows, rectify, size
from ghgs_lit.kernels.tile import PANEL

TABLE, FLAT = types.Array(types.float32, 2, "C"), types.Array(types.float32, 1, "C")
WIDTHS, FLAGS = types.Array(types.int64, 1, "C"), types.Array(types.boolean, 1, "C")


@cache
def attributes():
    """The compiled :func:`_attributes`."""
    return kernel_for(_attributes, TABLE, FLAT, WIDTHS, FLAGS, TABLE, types.int64, types.int64)


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
