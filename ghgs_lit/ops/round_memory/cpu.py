"""CPU kernel of the memory of the refinement rounds."""

import numpy as np
import torch
from torch import Tensor

from ghgs_lit.ops import memory, pool, simd
from ghgs_lit.ops.compile import FLOATS, NUMBER, helper, kernel_for
from ghgs_lit.ops.layers import PANEL, linear, lines, pack, put_rows, rectify, size
from ghgs_lit.ops.simd import LANES

ZERO = np.float32(0)
ONE = np.float32(1)


@helper
def see(view, hidden, views, shown, seen):
    """Accumulate a view in the values of the own view, the mean and the maximum of the other views.

    Args:
        view: index of the view, where 0 is the own view; call in ascending order.
        hidden: channels of a view.
        views: number of views.
        shown: values of the view, ``hidden`` lines of ``PANEL`` floats.
        seen: accumulated, 3 ``hidden`` lines.
    """
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


@kernel_for(FLOATS[3], FLOATS[2], FLOATS[2], FLOATS[1], FLOATS[2], NUMBER, NUMBER)
def remember_rows(each, known, before, layers, after, first, last):
    """Write rows of the new memory; see :mod:`ghgs_lit.ops.round_memory`.

    Args:
        each: observations in each view, the own view first [N, V, c].
        known: additional inputs of each Gaussian [N, k].
        before: memory of the previous rounds [N, h].
        layers: packed layers, from :func:`ghgs_lit.ops.layers.pack`.
        after: written in these rows [N, h].
        first: first row.
        last: end of the rows, excluded.
    """
    views = each.shape[1]
    channels = each.shape[2]
    hidden = before.shape[1]
    inputs = 4 * hidden + known.shape[1]
    to_deep = size(hidden, channels)
    to_update = to_deep + size(hidden, hidden)
    to_narrow = to_update + size(2 * hidden, inputs)
    to_memory = to_narrow + size(hidden, 2 * hidden)
    biases = to_memory + lines(hidden) * hidden
    seen = simd.aligned(inputs * PANEL)
    widest = max(lines(2 * hidden), channels) * PANEL
    one = simd.aligned(widest)
    two = simd.aligned(widest)
    for start in range(first, last, PANEL):
        count = min(PANEL, last - start)
        for view in range(views):
            put_rows(each[:, view], start, count, 0, one)
            linear(layers, 0, hidden, channels, one, two)
            rectify(layers, 0, hidden, channels, two)
            linear(layers, to_deep, hidden, hidden, two, one)
            rectify(layers, to_deep, hidden, hidden, one)
            see(view, hidden, views, one, seen)
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
                memory.store(one, i, simd.tanh(old + memory.load(one, i) + layers[biases + channel]))
        for lane in range(count):
            for channel in range(hidden):
                after[start + lane, channel] = one[channel * PANEL + lane]


#: Gaussians in one task, and the work of a Gaussian in the unit of :func:`ghgs_lit.ops.pool.run`.
_TASK = 512
WORK = 8


def remember(each: Tensor, known: Tensor, before: Tensor, weights: list[Tensor]) -> Tensor:
    """Kernel of the operator of :mod:`ghgs_lit.ops.round_memory`; see its ``plain``."""
    after = torch.empty_like(before, memory_format=torch.contiguous_format)
    rows = [x.detach().contiguous().numpy() for x in (each, known, before)]
    given = (*rows, pack(weights), after.numpy())
    pool.run_rows(remember_rows(), given, [(0, len(before))], _TASK, WORK * len(before))
    return after
