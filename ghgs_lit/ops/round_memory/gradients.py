"""CPU kernel of the gradients of the rounds' memory; it recomputes hidden layers, within the cache."""

from collections.abc import Sequence
from functools import partial

import numpy as np
import torch
from numba.core import types
from torch import Tensor

from ghgs_lit.ops import memory, pool, simd
from ghgs_lit.ops.compile import FLOATS, NUMBER, helper, kernel_for
from ghgs_lit.ops.layers import (
    PANEL,
    Sums,
    learn,
    linear,
    lines,
    pack,
    put_ones,
    put_rows,
    put_slopes,
    rectify,
    unrectify,
)
from ghgs_lit.ops.round_memory.cpu import ONE, WORK, ZERO, see
from ghgs_lit.ops.simd import LANES

_LAYERS = (FLOATS[1], FLOATS[1], types.Array(types.int64, 2, "C"), FLOATS[1])


@helper
def _unsee(view, hidden, views, shown, seen, slopes, own):
    """Write the gradient of a view's values; of equal maxima, the first view gets the gradient.

    Args:
        view: index of the view, where 0 is the own view.
        hidden: channels of a view.
        views: number of views.
        shown: values of the view, lines of ``PANEL`` floats.
        seen: values of the own view, mean and maximum of the other views.
        slopes: gradients of ``seen``; the gradient of a maximum is set to 0 once a view has received it.
        own: written, gradients of ``shown``.
    """
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
def _view_part(view, views, buffer):
    """The part of a buffer that belongs to a view."""
    each = len(buffer) // views
    return buffer[view * each : (view + 1) * each]


@helper
def _layer(layers, place, outputs, inputs, before, after):
    """Compute ``after = max(W before + b, 0)`` of a packed layer, followed by a line of ones."""
    linear(layers, place, outputs, inputs, before, after)
    rectify(layers, place, outputs, inputs, after)
    put_ones(outputs, after)


@helper
def _look(each, known, before, layers, places, start, count, given, one, two, seen, up, narrow):
    """Recompute the inputs of all five layers for ``count`` rows, 1 to ``PANEL``.

    All written buffers are lines of ``PANEL`` floats.

    Args:
        each: observations in each view, the own view first [N, V, c].
        known: additional inputs of each Gaussian [N, k].
        before: memory of the previous rounds [N, h].
        layers: packed layers, from :func:`ghgs_lit.ops.layers.pack`.
        places: [layers + 1, 3]; see :class:`ghgs_lit.ops.layers.Sums`.
        start: first row.
        count: number of rows.
        given: written, observations in each view.
        one: written, outputs of the first layer of each view.
        two: written, outputs of the second layer of each view.
        seen: written, inputs of the update MLP.
        up: written, outputs of its first layer.
        narrow: written, outputs of its second layer.
    """
    views = each.shape[1]
    channels = each.shape[2]
    hidden = before.shape[1]
    inputs = 4 * hidden + known.shape[1]
    wide = 2 * hidden
    for view in range(views):
        x = _view_part(view, views, given)
        a = _view_part(view, views, one)
        b = _view_part(view, views, two)
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
    """Write the gradients of the previous memory, and accumulate those of the layers; see
    :mod:`ghgs_lit.ops.round_memory`.

    Args:
        each: observations in each view, the own view first [N, V, c].
        known: additional inputs of each Gaussian [N, k].
        before: memory of the previous rounds [N, h].
        after: the new memory [N, h].
        slopes: gradients of ``after`` [N, h].
        layers: packed layers, from :func:`ghgs_lit.ops.layers.pack`.
        backs: the packed transposed layers.
        places: [layers + 1, 3]; see :class:`ghgs_lit.ops.layers.Sums`.
        sums: accumulated, gradients of the layers in one task.
        d_before: written in these rows [N, h].
        first: first row.
        last: end of the rows, excluded.
    """
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
            x = _view_part(view, views, given)
            a = _view_part(view, views, one)
            b = _view_part(view, views, two)
            _unsee(view, hidden, views, b, seen, slope, down)
            unrectify(b, hidden, down)
            learn(a, hidden, down, hidden, turned, places[1, 2], sums)
            linear(backs, places[1, 1], hidden, hidden, down, up)
            unrectify(a, hidden, up)
            learn(x, channels, up, hidden, turned, places[0, 2], sums)


#: Gaussians in one task; each task has its own sums.
_LEARNED = 2048


def gradients(
    rows: Sequence[Tensor], weights: Sequence[Tensor], slopes: Tensor
) -> tuple[Tensor, list[Tensor]]:
    """Compute the gradients of the previous memory, and of weights and biases.

    Args:
        rows: observations, additional inputs, and the memory before and after.
        weights: weights and biases of the five layers, alternating.
        slopes: gradients of the memory after.
    """
    parts = pool.even_parts(len(slopes), _LEARNED)
    sums = Sums(weights, len(parts))
    d_before = torch.empty_like(slopes, memory_format=torch.contiguous_format)
    arrays = [x.detach().contiguous().numpy() for x in (*rows, slopes)]
    layers = pack(weights), pack(weights, transposed=True), sums.places
    tasks = [
        partial(remember_back(), *arrays, *layers, own, d_before.numpy(), part.start, part.stop)
        for own, part in zip(sums.of_task, parts, strict=True)
    ]
    pool.run(tasks, 4 * WORK * len(slopes))
    return d_before, list(sums.gradients())
