"""Small MLPs inside Numba kernels, ``PANEL`` rows at a time, and their gradients.

Matrix products accumulate in registers: a tile of the result is ``ROWS`` x ``PANEL``; the right factor
is a panel, ``PANEL`` numbers for each step of the sum.

Values are stored channel by channel: a channel is a line of ``PANEL`` floats, one lane per row. The
output of a layer therefore has the layout of the next layer's input. The gradient of a layer's input
is a product with the transposed weights; the gradient of its weights and biases is a sum over lanes,
for which a line of ones follows the channels of the input.

``emit(context, builder, sig, args)`` writes the LLVM instructions of a function decorated with
``@intrinsic``; kernels call it without its first parameter, Numba's ``typing_context``.
"""

from collections.abc import Sequence

import numpy as np
import torch
from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic
from torch import Tensor

from ghgs_lit.ops import memory, simd
from ghgs_lit.ops.compile import helper, processor_features
from ghgs_lit.ops.memory import pointer_to
from ghgs_lit.ops.simd import I64, LANES, call, constant, everywhere, floats

#: Rows and columns of a tile, which takes 24 of the 32 registers of AVX-512 or 12 of the 16 of AVX2.
#: They divide ``QUERIES`` and ``WIDTH`` of ``ops.attention``.
ROWS, PANEL = (12, 32) if "avx512f" in processor_features() else (6, 16)


def _steps(builder, rows, row_stride: int, step_stride: int, panel, steps, totals) -> None:
    """Emit the loop that adds the products of each row and the panel to ``totals``.

    Args:
        builder: LLVM IR builder.
        rows: pointer to the first number of the first row.
        row_stride: distance of rows, in numbers.
        step_stride: distance of steps, in numbers.
        panel: pointer to the panel, ``PANEL`` floats for each step.
        steps: length of the sum, an LLVM integer.
        totals: pointers to the sums, [ROWS][PANEL / LANES] vectors.
    """
    with cgutils.for_range(builder, steps, intp=I64) as loop:
        line = builder.gep(panel, [builder.mul(loop.index, ir.Constant(I64, PANEL))])
        parts = []
        for j in range(PANEL // LANES):
            place = builder.gep(line, [ir.Constant(I64, LANES * j)])
            parts.append(builder.load(builder.bitcast(place, floats.llvm.as_pointer()), align=64))
        first = builder.gep(rows, [builder.mul(loop.index, ir.Constant(I64, step_stride))])
        for r in range(ROWS):
            number = builder.load(builder.gep(first, [ir.Constant(I64, row_stride * r)]))
            x = everywhere(builder, number, LANES)
            for part, total in zip(parts, totals[r], strict=True):
                builder.store(call(builder, "fmuladd", floats, x, part, builder.load(total)), total)


def make_product(strides: tuple[int, int], adds: bool):
    """Make an intrinsic that multiplies ``ROWS`` rows with a panel.

    Args:
        strides: distances of rows and of steps, in numbers; compile-time constants, so that all
            registers are free for the tile.
        adds: add the product to ``out`` instead of overwriting it.

    Returns:
        A Numba intrinsic ``product(x, x_at, panels, panel_at, steps, out, out_at, out_stride)``.
    """

    @intrinsic
    def product(typing_context, x, x_at, panels, panel_at, steps, out, out_at, out_stride):
        """Multiply ``ROWS`` rows of ``x`` with a panel, giving a ``ROWS`` x ``PANEL`` tile of ``out``.

        Args:
            typing_context: Numba's.
            x: flat float32.
            x_at: index of the first number of the first row.
            panels: flat float32, aligned to a cache line.
            panel_at: index of the panel, a multiple of 16.
            steps: length of the sum.
            out: flat float32, aligned to a cache line.
            out_at: index of the first number of the tile, a multiple of 16.
            out_stride: distance of rows of ``out`` in numbers, a multiple of 16.
        """

        def emit(context, builder, sig, args):
            def place(k):
                return pointer_to(
                    context, builder, sig.args[k], args[k], args[k + 1], types.int64, ir.FloatType()
                )

            count = PANEL // LANES
            # LLVM promotes these to registers, since their addresses do not leave this function.
            totals = []
            for _ in range(ROWS):
                totals.append([cgutils.alloca_once(builder, floats.llvm) for _ in range(count)])
            for row in totals:
                for total in row:
                    builder.store(constant(floats, 0.0), total)
            _steps(builder, place(0), *strides, place(2), args[4], totals)
            first = place(5)
            for r, row in enumerate(totals):
                line = builder.gep(first, [builder.mul(args[7], ir.Constant(I64, r))])
                for j, total in enumerate(row):
                    target = builder.gep(line, [ir.Constant(I64, LANES * j)])
                    target = builder.bitcast(target, floats.llvm.as_pointer())
                    value = builder.load(total)
                    if adds:
                        value = builder.fadd(builder.load(target, align=64), value)
                    builder.store(value, target, align=64)
            return context.get_dummy_value()

        i = types.int64
        return types.void(x, i, panels, i, i, out, i, i), emit

    return product


#: ``out = x y``, where the numbers of all rows for one step are contiguous.
product = make_product((1, ROWS), adds=False)


ZERO = np.float32(0)
ONE = np.float32(1)

#: ``out += x y^T``, summed over lanes; ``x`` is lines, ``y`` has the layout of :func:`_turn`.
_lane_product = make_product((PANEL, 1), adds=True)


def room(channels: int) -> int:
    """Number of lines written by a layer with ``channels`` outputs, rounded up to whole tiles."""
    return -(-channels // ROWS) * ROWS


def pack(numbers: Sequence[Tensor], transposed: bool = False) -> np.ndarray:
    """Pack layers into one flat array.

    Args:
        numbers: weight [outputs, inputs] and bias [outputs] of each layer.
        transposed: pack transposed weights, with biases of 0.

    Returns:
        For each layer, the weights in tiles of ``ROWS`` outputs, each [inputs, ROWS], then the
        biases; float32.
    """
    parts = []
    for weight, bias in _pairs(numbers):
        weight = weight.detach().numpy()
        weight = weight.T if transposed else weight
        outputs, inputs = weight.shape
        both = np.zeros((room(outputs), inputs + 1), np.float32)
        both[:outputs, :-1] = weight
        both[:outputs, -1] = 0 if transposed else bias.detach().numpy()
        parts += [both[:, :-1].reshape(-1, ROWS, inputs).swapaxes(1, 2).ravel(), both[:, -1]]
    return np.concatenate(parts)


def _pairs(numbers: Sequence) -> list[tuple]:
    """Pairs of weight and bias of each layer."""
    return list(zip(numbers[::2], numbers[1::2], strict=True))


class Sums:
    """Gradients of layers, accumulated separately by each task of a kernel.

    Args:
        numbers: weight [outputs, inputs] and bias [outputs] of each layer.
        tasks: number of concurrent tasks.

    Attributes:
        places: offsets of the packed weights, the transposed weights and the sums of each layer,
            [layers + 1, 3].
        of_task: sums of each task, written by :func:`learn`, [tasks, numbers].
    """

    def __init__(self, numbers: Sequence[Tensor], tasks: int):
        self._shapes = [tuple(weight.shape) for weight, _ in _pairs(numbers)]
        self._blocks = [(-(-o // PANEL), room(i + 1), PANEL) for o, i in self._shapes]
        counts = [(room(o) * (i + 1), room(i) * (o + 1)) for o, i in self._shapes]
        sizes = [(*count, int(np.prod(block))) for count, block in zip(counts, self._blocks, strict=True)]
        self.places = np.cumsum([(0, 0, 0), *sizes], 0)
        self.of_task = simd.aligned_floats(tasks * self.places[-1, 2]).reshape(tasks, -1)
        self.of_task[:] = 0

    def gradients(self) -> list[Tensor]:
        """Gradients of the weight and bias of each layer, summed over tasks."""
        sums = np.split(self.of_task.sum(0), self.places[1:-1, 2])
        both = [
            part.reshape(block).swapaxes(1, 2).reshape(-1, block[1])[: shape[0], : shape[1] + 1]
            for part, block, shape in zip(sums, self._blocks, self._shapes, strict=True)
        ]
        gradients = []
        for each in both:
            gradients += [torch.tensor(each[:, :-1]), torch.tensor(each[:, -1])]
        return gradients


#: :func:`room` inside kernels.
lines = helper(room)


@helper
def size(outputs, inputs):
    """Number of floats of a packed layer with these channels of output and input."""
    return lines(outputs) * (inputs + 1)


@helper
def put_rows(table, first, count, line, values):
    """Copy rows of a table to lines; the last row fills the remaining lanes.

    Args:
        table: float32 [rows, channels].
        first: first row.
        count: number of rows, 1 to ``PANEL``.
        line: first line to write.
        values: lines of ``PANEL`` floats, flat.
    """
    for lane in range(PANEL):
        row = first + min(lane, count - 1)
        for channel in range(table.shape[1]):
            values[(line + channel) * PANEL + lane] = table[row, channel]


@helper
def linear(layers, at, outputs, inputs, values, result):
    """Compute ``result = W values`` of a packed layer, without its biases.

    Args:
        layers: packed layers, from :func:`pack`.
        at: offset of the layer.
        outputs: channels of the result.
        inputs: channels of ``values``.
        values: lines of ``PANEL`` floats, flat.
        result: written, ``room(outputs)`` lines.
    """
    for row in range(0, outputs, ROWS):
        product(layers, at + row * inputs, values, 0, inputs, result, row * PANEL, PANEL)


@helper
def rectify(layers, at, outputs, inputs, values):
    """Compute ``values = max(values + b, 0)`` with the biases of a packed layer; NaN stays NaN.

    Args:
        layers: packed layers, from :func:`pack`.
        at: offset of the layer.
        outputs: channels of ``values``.
        inputs: channels of the layer's input.
        values: lines of ``PANEL`` floats, flat; changed in place.
    """
    biases = at + lines(outputs) * inputs
    for channel in range(outputs):
        for i in range(channel * PANEL, (channel + 1) * PANEL, LANES):
            memory.store(values, i, simd.maximum(ZERO, memory.load(values, i) + layers[biases + channel]))


@helper
def put_ones(line, values):
    """Fill the line with index ``line`` with ones, the input of biases."""
    for i in range(line * PANEL, (line + 1) * PANEL, LANES):
        memory.store(values, i, simd.full(ONE))


@helper
def put_slopes(table, first, count, values):
    """Copy rows of a table to lines; the other lanes become 0.

    Args:
        table: float32 [rows, channels].
        first: first row.
        count: number of rows, at most ``PANEL``.
        values: written, a line of ``PANEL`` floats for each channel.
    """
    for lane in range(PANEL):
        for channel in range(table.shape[1]):
            value = table[first + lane, channel] if lane < count else ZERO
            values[channel * PANEL + lane] = value


@helper
def unrectify(values, channels, slopes):
    """Replace the gradient of a ReLU's output by the gradient of its input.

    Args:
        values: outputs of the ReLU, lines of ``PANEL`` floats.
        channels: number of lines.
        slopes: gradients, changed in place.
    """
    for i in range(0, channels * PANEL, LANES):
        is_off = memory.load(values, i) <= ZERO
        memory.store(slopes, i, simd.select(is_off, ZERO, memory.load(slopes, i)))


@helper
def _turn(slopes, channels, turned):
    """Transpose lines to panels of ``PANEL`` channels, one row per lane; writes whole panels."""
    for channel in range(channels):
        at = channel // PANEL * PANEL * PANEL + channel % PANEL
        for lane in range(PANEL):
            turned[at + lane * PANEL] = slopes[channel * PANEL + lane]


@helper
def learn(values, inputs, slopes, outputs, turned, at, sums):
    """Add the gradients of a layer's weights and biases to ``sums``.

    Args:
        values: inputs of the layer and a line of ones, lines of ``PANEL`` floats.
        inputs: channels of the layer's input.
        slopes: gradients of the layer's outputs, lines of ``PANEL`` floats.
        outputs: channels of the layer's output.
        turned: buffer for ``slopes`` as whole panels.
        at: offset of the layer's sums.
        sums: sums of one task; see :class:`Sums`.
    """
    _turn(slopes, outputs, turned)
    rows = lines(inputs + 1)
    for panel in range(0, outputs, PANEL):
        for row in range(0, rows, ROWS):
            to = at + panel * rows + row * PANEL
            _lane_product(values, row * PANEL, turned, panel * PANEL, PANEL, sums, to, PANEL)
