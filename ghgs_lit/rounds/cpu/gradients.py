"""Gradients of the memory of rounds; values of inner layers are computed again, which stays in the cache."""

import numpy as np
from numba.core import types

from ghgs_lit.kernels import memory, simd
from ghgs_lit.kernels.compile import FLOATS, NUMBER, helper, kernel_for
from ghgs_lit.kernels.layers import (
    PANEL,
    learn,
    linear,
    lines,
    put_ones,
    put_rows,
    put_slopes,
    rectify,
    unrectify,
)
from ghgs_lit.kernels.simd import LANES
from ghgs_lit.rounds.cpu.kernel import ONE, ZERO, see

_LAYERS = (FLOATS[1], FLOATS[1], types.Array(types.int64, 2, "C"), FLOATS[1])


@helper
def _unsee(view, hidden, views, shown, seen, slopes, own):
    """Write the gradient of a view's values to ``own``; of equal maxima the first view gets the gradient."""
    size = hidden * PANEL
    share = ONE / np.float32(views - 1)
    for i in range(0, size, LANES):
        if view == 0:
            memory.store(own, i, memory.load(slopes, i))
        else:
            most = memory.load(seen, 2 * size + i)
            slope = memory.load(slopes, 2 * size + i)
            is_most = memory.load(shown, i) == most
            mean = share * memory.load(slopes, size + i)
            memory.store(own, i, mean + simd.select(is_most, slope, ZERO))
            memory.store(slopes, 2 * size + i, simd.select(is_most, ZERO, slope))


@helper
def _of(view, views, buffer):
    each = len(buffer) // views
    return buffer[view * each : (view + 1) * each]


@helper
def _layer(layers, place, outputs, inputs, before, after):
    linear(layers, place, outputs, inputs, before, after)
    rectify(layers, place, outputs, inputs, after)
    put_ones(outputs, after)


@helper
def _look(each, known, before, layers, places, start, count, given, one, two, seen, up, narrow):
    """Compute the inputs of all layers: two of each view, two of the update and the last one."""
    views = each.shape[1]
    channels = each.shape[2]
    hidden = before.shape[1]
    inputs = 4 * hidden + known.shape[1]
    wide = 2 * hidden
    for view in range(views):
        x = _of(view, views, given)
        a = _of(view, views, one)
        b = _of(view, views, two)
        put_rows(each[:, view], start, count, 0, x)
        put_ones(channels, x)
        _layer(layers, places[0, 0], hidden, channels, x, a)
        _layer(layers, places[1, 0], hidden, hidden, a, b)
        see(view, hidden, views, b, seen)
    put_rows(known, start, count, 3 * hidden, seen)
    put_rows(before, start, count, inputs - hidden, seen)
    put_ones(inputs, seen)
    _layer(layers, places[2, 0], wide, inputs, seen, up)
    _layer(layers, places[3, 0], hidden, wide, up, narrow)


@kernel_for(FLOATS[3], *[FLOATS[2]] * 4, *_LAYERS, FLOATS[2], NUMBER, NUMBER)
def remember_back(
    each, known, before, after, slopes, layers, backs, places, sums, d_before, first, last
):  # fmt: skip
    """Write ``d_before`` of rows ``first`` to ``last`` and add to ``sums``; see
    :func:`ghgs_lit.rounds.cpu.remembered`."""
    views = each.shape[1]
    channels = each.shape[2]
    hidden = before.shape[1]
    inputs = 4 * hidden + known.shape[1]
    wide = 2 * hidden
    line = lines(hidden + 1) * PANEL
    most = lines(inputs + 1) * PANEL
    given = simd.aligned(views * lines(channels + 1) * PANEL)
    one = simd.aligned(views * line)
    two = simd.aligned(views * line)
    seen = simd.aligned(most)
    slope = simd.aligned(most)
    turned = simd.aligned(most + PANEL * PANEL)
    up = simd.aligned(2 * line)
    narrow = simd.aligned(line)
    down = simd.aligned(2 * line)
    for buffer in (given, one, two, seen, up, narrow, turned):  # padding must be finite
        buffer[:] = ZERO
    for start in range(first, last, PANEL):
        count = min(PANEL, last - start)
        _look(each, known, before, layers, places, start, count, given, one, two, seen, up, narrow)
        put_slopes(slopes, start, count, down)
        for lane in range(count):
            for channel in range(hidden):
                value = after[start + lane, channel]
                down[channel * PANEL + lane] *= ONE - value * value
                d_before[start + lane, channel] = down[channel * PANEL + lane]
        learn(narrow, hidden, down, hidden, turned, places[4, 2], sums)
        linear(backs, places[4, 1], hidden, hidden, down, slope)
        unrectify(narrow, hidden, slope)
        learn(up, wide, slope, hidden, turned, places[3, 2], sums)
        linear(backs, places[3, 1], wide, hidden, slope, down)
        unrectify(up, wide, down)
        learn(seen, inputs, down, wide, turned, places[2, 2], sums)
        linear(backs, places[2, 1], inputs, wide, down, slope)
        for lane in range(count):
            for channel in range(hidden):
                d_before[start + lane, channel] += slope[(inputs - hidden + channel) * PANEL + lane]
        for view in range(views):
            x = _of(view, views, given)
            a = _of(view, views, one)
            b = _of(view, views, two)
            _unsee(view, hidden, views, b, seen, slope, down)
            unrectify(b, hidden, down)
            learn(a, hidden, down, hidden, turned, places[1, 2], sums)
            linear(backs, places[1, 1], hidden, hidden, down, up)
            unrectify(a, hidden, up)
            learn(x, channels, up, hidden, turned, places[0, 2], sums)
