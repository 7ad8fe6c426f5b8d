"""What :class:`ghgs_lit.rounds.Rounds` remembers of each Gaussian, ``PANEL`` Gaussians at once."""

from functools import cache

import numpy as np
from numba.core import types

from ghgs_lit.kernels import memory, simd
from ghgs_lit.kernels.compile import helper, kernel_for
from ghgs_lit.kernels.layers import ONE, linear, lines, put_rows, rectify, size, tanh
from ghgs_lit.kernels.simd import LANES
from ghgs_lit.kernels.tile import PANEL

FLOATS = [types.Array(types.float32, dimensions, "C") for dimensions in range(4)]


@cache
def remember():
    """The compiled :func:`_remember`."""
    return kernel_for(_remember, FLOATS[3], FLOATS[2], FLOATS[2], FLOATS[1], FLOATS[2], *[types.int64] * 2)


@helper
def _see(view, hidden, views, shown, seen):
    """Put what a view shows into ``seen``: the own view's, then the others' mean and their maximum."""
    size = hidden * PANEL
    share = ONE / np.float32(views - 1)
    for i in range(0, size, LANES):
        value = memory.load(shown, i)
        if view == 0:
            memory.store(seen, i, value)
        elif view == 1:
            memory.store(seen, size + i, value * share)
            memory.store(seen, 2 * size + i, value)
        else:
            memory.store(seen, size + i, simd.fma(value, share, memory.load(seen, size + i)))
            most = simd.maximum(memory.load(seen, 2 * size + i), value)
            memory.store(seen, 2 * size + i, most)


def _remember(each, known, before, layers, after, first, last):
    """Write rows ``first`` to ``last`` of ``after``; see :func:`ghgs_lit.rounds.cpu.remembered`."""
    views, channels, hidden = each.shape[1], each.shape[2], before.shape[1]
    inputs = 4 * hidden + known.shape[1]
    to_deep = size(hidden, channels)
    to_update = to_deep + size(hidden, hidden)
    to_narrow = to_update + size(2 * hidden, inputs)
    to_memory = to_narrow + size(hidden, 2 * hidden)
    biases = to_memory + lines(hidden) * hidden
    seen = simd.aligned(inputs * PANEL)
    widest = max(lines(2 * hidden), channels) * PANEL
    one, two = simd.aligned(widest), simd.aligned(widest)
    for start in range(first, last, PANEL):
        count = min(PANEL, last - start)
        for view in range(views):
            put_rows(each[:, view], start, count, 0, one)
            linear(layers, 0, hidden, channels, one, two)
            rectify(layers, 0, hidden, channels, two)
            linear(layers, to_deep, hidden, hidden, two, one)
            rectify(layers, to_deep, hidden, hidden, one)
            _see(view, hidden, views, one, seen)
        put_rows(known, start, count, 3 * hidden, seen)
        put_rows(before, start, count, inputs - hidden, seen)
        linear(layers, to_update, 2 * hidden, inputs, seen, one)
        rectify(layers, to_update, 2 * hidden, inputs, one)
        linear(layers, to_narrow, hidden, 2 * hidden, one, two)
        rectify(layers, to_narrow, hidden, 2 * hidden, two)
        linear(layers, to_memory, hidden, hidden, two, one)
        for channel in range(hidden):
            for i in range(channel * PANEL, (channel + 1) * PANEL, LANES):
                old = memory.load(seen, (inputs - hidden) * PANEL + i)
                memory.store(one, i, tanh(old + memory.load(one, i) + layers[biases + channel]))
        for lane in range(count):
            for channel in range(hidden):
                after[start + lane, channel] = one[channel * PANEL + lane]
