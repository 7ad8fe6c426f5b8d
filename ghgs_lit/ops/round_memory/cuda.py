"""Triton kernel of the memory of the refinement rounds; a row is a Gaussian."""

import torch
import triton
import triton.language as tl
from torch import Tensor

from ghgs_lit.ops.tiles import rows_of, tanh


@triton.jit
def part_of(table, row, first, count, length, COLUMNS: tl.constexpr):
    """Load some columns of rows of a table, padded with 0.

    Args:
        table: pointer to a contiguous table of ``length`` columns.
        row: indices of rows [ROWS].
        first: first column.
        count: number of columns to load.
        length: number of columns of the table.
        COLUMNS: columns of the result, a power of two.

    Returns:
        Values [ROWS, COLUMNS].
    """
    column = tl.arange(0, COLUMNS)[None]
    return tl.load(table + row[:, None] * length + first + column, mask=column < count, other=0.0)


@triton.jit
def times(
    x, weight, first, count, length, top, outputs, INPUTS: tl.constexpr, OUTPUTS: tl.constexpr
):  # fmt: skip
    """Multiply rows with a part of the weight of a linear layer.

    Args:
        x: [ROWS, INPUTS], 0 from column ``count`` on.
        weight: pointer to [outputs, length].
        first: first column of the part.
        count: number of columns of the part.
        length: inputs of the layer.
        top: first row of the part.
        outputs: outputs of the layer.
        INPUTS: a power of two, at least ``count``.
        OUTPUTS: rows of the part, a power of two.

    Returns:
        Products [ROWS, OUTPUTS], 0 beyond the layer's outputs.
    """
    column = tl.arange(0, INPUTS)[:, None]
    row = top + tl.arange(0, OUTPUTS)[None]
    inside = (column < count) & (row < outputs)
    part = tl.load(weight + row * length + first + column, mask=inside, other=0.0)
    return tl.dot(x, part, input_precision="tf32")


@triton.jit
def biases(bias, top, outputs, OUTPUTS: tl.constexpr):
    """Part of a bias [outputs] from ``top`` on, as a row [1, OUTPUTS] padded with 0."""
    column = top + tl.arange(0, OUTPUTS)
    return tl.load(bias + column, mask=column < outputs, other=0.0)[None]


@triton.jit
def positive(x):
    """ReLU; NaN stays NaN, as in PyTorch."""
    return tl.where(x < 0, 0.0, x)


@triton.jit
def seen_by(
    each, row, view_0, bias_0, view_1, bias_1, channels, hidden, CHANNELS: tl.constexpr, HIDDEN: tl.constexpr
):
    """Apply the view MLP to observations, giving [ROWS, HIDDEN].

    Args:
        each: pointer to observations [rows, channels].
        row: indices of rows [ROWS].
        view_0: weight of the first layer [hidden, channels].
        bias_0: bias of the first layer [hidden].
        view_1: weight of the second layer [hidden, hidden].
        bias_1: bias of the second layer [hidden].
        channels: channels of an observation.
        hidden: width of the MLP.
        CHANNELS: a power of two, at least ``channels``.
        HIDDEN: a power of two, at least ``hidden``.
    """
    x = part_of(each, row, 0, channels, channels, CHANNELS)
    x = times(x, view_0, 0, channels, channels, 0, hidden, CHANNELS, HIDDEN)
    x = positive(x + biases(bias_0, 0, hidden, HIDDEN))
    x = times(x, view_1, 0, hidden, hidden, 0, hidden, HIDDEN, HIDDEN)
    return positive(x + biases(bias_1, 0, hidden, HIDDEN))


@triton.jit
def remember_rows(
    count, each, known, memory, view_0, bias_0, view_1, bias_1, update_0, bias_2, update_1, bias_3, last,
    bias_4, out, views, channels, hidden, more, wide, CHANNELS: tl.constexpr, HIDDEN: tl.constexpr,
    MORE: tl.constexpr, WIDE: tl.constexpr, ROWS: tl.constexpr,
):  # fmt: skip
    """Write the new memory of ``ROWS`` Gaussians.

    Args:
        count: number N of Gaussians.
        each: observations [N, views, channels].
        known: additional inputs [N, more].
        memory: memory of the previous rounds [N, hidden].
        view_0: weight of the first layer of the view MLP [hidden, channels].
        bias_0: [hidden].
        view_1: weight of its second layer [hidden, hidden].
        bias_1: [hidden].
        update_0: weight of the first layer of the update MLP [wide, 4 hidden + more], whose inputs are
            the own view, the mean and the maximum of the other views, the additional inputs, and the
            memory.
        bias_2: [wide].
        update_1: weight of its second layer [hidden, wide].
        bias_3: [hidden].
        last: weight of the output layer [hidden, hidden].
        bias_4: [hidden].
        out: written [N, hidden].
        views: views of a Gaussian, at least 2.
        channels: channels of an observation.
        hidden: width of the memory.
        more: number of additional inputs.
        wide: width of the update MLP.
        CHANNELS: a power of two, at least ``channels``.
        HIDDEN: a power of two, at least ``hidden``.
        MORE: a power of two, at least ``more``.
        WIDE: channels of the update MLP that are computed together.
        ROWS: Gaussians per program.
    """
    i = rows_of(count, ROWS)
    length = 4 * hidden + more
    own = seen_by(each, i * views, view_0, bias_0, view_1, bias_1, channels, hidden, CHANNELS, HIDDEN)
    mean = tl.zeros_like(own)
    most = tl.zeros_like(own)  # values are not negative
    for view in range(1, views):
        row = i * views + view
        x = seen_by(each, row, view_0, bias_0, view_1, bias_1, channels, hidden, CHANNELS, HIDDEN)
        mean += x
        most = tl.maximum(most, x, propagate_nan=tl.PropagateNan.ALL)
    mean = mean / (views - 1)
    known = part_of(known, i, 0, more, more, MORE)
    before = part_of(memory, i, 0, hidden, hidden, HIDDEN)
    updated = tl.zeros_like(own)
    for top in range(0, wide, WIDE):
        x = times(own, update_0, 0, hidden, length, top, wide, HIDDEN, WIDE)
        x += times(mean, update_0, hidden, hidden, length, top, wide, HIDDEN, WIDE)
        x += times(most, update_0, 2 * hidden, hidden, length, top, wide, HIDDEN, WIDE)
        x += times(known, update_0, 3 * hidden, more, length, top, wide, MORE, WIDE)
        x += times(before, update_0, 3 * hidden + more, hidden, length, top, wide, HIDDEN, WIDE)
        x = positive(x + biases(bias_2, top, wide, WIDE))
        updated += times(x, update_1, top, wide - top, wide, 0, hidden, WIDE, HIDDEN)
    x = positive(updated + biases(bias_3, 0, hidden, HIDDEN))
    x = times(x, last, 0, hidden, hidden, 0, hidden, HIDDEN, HIDDEN) + biases(bias_4, 0, hidden, HIDDEN)
    column = tl.arange(0, HIDDEN)[None]
    tl.store(out + i[:, None] * hidden + column, tanh(before + x), mask=column < hidden)


#: Gaussians per program: their values and a part of a weight fit into registers.
_TOGETHER = 32


def remember(each: Tensor, known: Tensor, memory: Tensor, weights: list[Tensor]) -> Tensor:
    """Kernel of the operator of :mod:`ghgs_lit.ops.round_memory`; see its ``plain``."""
    count, views, channels = each.shape
    out = torch.empty_like(memory, memory_format=torch.contiguous_format)
    numbers = (channels, memory.shape[1], known.shape[1], len(weights[4]))
    names = ("CHANNELS", "HIDDEN", "MORE")
    sizes = {name: max(triton.next_power_of_2(n), 16) for name, n in zip(names, numbers, strict=False)}
    if count:
        read = [x.contiguous() for x in (each, known, memory, *weights)]
        grid = (triton.cdiv(count, _TOGETHER),)
        remember_rows[grid](count, *read, out, views, *numbers, **sizes, WIDE=32, ROWS=_TOGETHER, num_warps=8)
    return out
