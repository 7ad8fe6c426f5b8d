"""The kernel of the rounds' memory for a GPU, in Triton: a row is a Gaussian."""

import torch
import triton
import triton.language as tl
from torch import Tensor

from ghgs_lit.ops.tiles import rows_of, tanh


@triton.jit
def part_of(table, row, first, count, length, COLUMNS: tl.constexpr):
    """Part of rows of a table, 0 beyond it.

    Args:
        table: pointer to a contiguous table of ``length`` columns.
        row: [ROWS].
        first: column of the part.
        count: number of its columns.
        length: number of columns of the table.
        COLUMNS: of the result, a power of two.

    Returns:
        Values [ROWS, COLUMNS].
    """
    column = tl.arange(0, COLUMNS)[None]
    return tl.load(table + row[:, None] * length + first + column, mask=column < count, other=0.0)


@triton.jit
def times(
    x, weight, first, count, length, top, outputs, INPUTS: tl.constexpr, OUTPUTS: tl.constexpr
):  # fmt: skip
    """Product of rows with a part of the weight of a linear layer.

    Args:
        x: [ROWS, INPUTS], 0 from ``count`` on.
        weight: pointer to [outputs, length].
        first: column of the part.
        count: number of its columns.
        length: inputs of the layer.
        top: row of the part.
        outputs: of the layer.
        INPUTS: ``count`` or more, a power of two.
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
    """Part of a bias as a row [1, OUTPUTS].

    Args:
        bias: [outputs] numbers.
        top: the first one that is read.
        outputs: their number; beyond them the row is 0.
        OUTPUTS: length of the row, a power of two.
    """
    column = top + tl.arange(0, OUTPUTS)
    return tl.load(bias + column, mask=column < outputs, other=0.0)[None]


@triton.jit
def positive(x):
    """Numbers above 0; what is not a number stays so, as in PyTorch."""
    return tl.where(x < 0, 0.0, x)


@triton.jit
def seen_by(
    each, row, view_0, bias_0, view_1, bias_1, channels, hidden, CHANNELS: tl.constexpr, HIDDEN: tl.constexpr
):
    """What the network of the views makes of observations: [ROWS, HIDDEN].

    Args:
        each: pointer to observations [rows, channels].
        row: [ROWS].
        view_0: weight of the first layer, [hidden, channels].
        bias_0: of the first layer.
        view_1: weight of the second layer, [hidden, hidden].
        bias_1: of the second layer.
        channels: of observations.
        hidden: width.
        CHANNELS: ``channels`` or more.
        HIDDEN: ``hidden`` or more.
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
    """Write the memory of ``ROWS`` Gaussians.

    Args:
        count: number N of Gaussians.
        each: [N, views, channels], observations.
        known: [N, more].
        memory: [N, hidden], before.
        view_0: weight [hidden, channels], as are the next ones with their biases.
        bias_0: [hidden].
        view_1: [hidden, hidden].
        bias_1: [hidden].
        update_0: [wide, 4 hidden + more]: of the own view, the mean and the largest of the others,
            what is known, the memory.
        bias_2: [wide].
        update_1: [hidden, wide].
        bias_3: [hidden].
        last: [hidden, hidden].
        bias_4: [hidden].
        out: [N, hidden], written.
        views: of a Gaussian, 2 or more.
        channels: of an observation.
        hidden: width of the memory.
        more: values that are known.
        wide: width of the update.
        CHANNELS: powers of two that hold these, as are the next ones.
        HIDDEN: of ``hidden``.
        MORE: of ``more``.
        WIDE: values of the update that are computed together.
        ROWS: Gaussians of a program.
    """
    i = rows_of(count, ROWS)
    length = 4 * hidden + more
    own = seen_by(each, i * views, view_0, bias_0, view_1, bias_1, channels, hidden, CHANNELS, HIDDEN)
    mean = tl.zeros_like(own)
    most = tl.zeros_like(own)  # no value is negative
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


#: Gaussians of a program: their values and a part of a weight fit into registers.
_TOGETHER = 32


def remember(each: Tensor, known: Tensor, memory: Tensor, weights: list[Tensor]) -> Tensor:
    """The operator of :mod:`ghgs_lit.ops.round_memory`.

    Args:
        each: observations of each view [N, V, c].
        known: beside them [N, k].
        memory: of the rounds before [N, h].
        weights: weights and biases of the five layers, in turn.

    Returns:
        The new memory [N, h].
    """
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
