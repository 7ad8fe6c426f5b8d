"""Pixels of four channels that lie side by side: between them, and one vector for each channel."""

from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic

from ghgs_lit.kernels.memory import pointer_to
from ghgs_lit.kernels.simd import I32, LANES, everywhere, floats, indices

#: Of a pixel.
CHANNELS = 4


def _vector(count: int) -> ir.VectorType:
    return ir.VectorType(ir.FloatType(), count)


def _between(builder, low, high, share):
    """``low + share (high - low)`` of two vectors of any length."""
    kind, share = low.type, everywhere(builder, share, low.type.count)
    function = ir.FunctionType(kind, [kind] * 3)
    callee = cgutils.get_or_insert_function(builder.module, function, f"llvm.fmuladd.v{kind.count}f32")
    return builder.call(callee, [share, builder.fsub(high, low), low])


@intrinsic
def interpolate(typing_context, pixels, at, line, right, down, out, place):
    """Write to ``out[place:]`` what lies between four pixels.

    The first is at ``pixels[at]``, that below it ``line`` numbers later; ``right`` and ``down`` are shares of
    the ways to the next ones. The two pixels of a line are loaded at once.
    """

    def emit(context, builder, sig, args):
        pair, array = _vector(2 * CHANNELS), sig.args[0]
        index, below = args[1], builder.add(args[1], args[2])
        lines = [
            builder.load(pointer_to(context, builder, array, args[0], i, types.intp, pair), align=4)
            for i in (index, below)
        ]
        column = _between(builder, *lines, args[4])
        sides = (
            builder.shuffle_vector(column, column, indices(range(k, k + CHANNELS))) for k in (0, CHANNELS)
        )
        target = pointer_to(context, builder, out, args[5], args[6], place, _vector(CHANNELS))
        builder.store(_between(builder, *sides, args[3]), target, align=16)
        return context.get_dummy_value()

    number = types.float32
    return types.void(pixels, types.intp, types.intp, number, number, out, place), emit


@intrinsic
def channels_of(typing_context, pixels, at):
    """The channels of 16 pixels from ``pixels[at]`` on, one vector for each."""

    def emit(context, builder, sig, args):
        address = pointer_to(context, builder, pixels, *args, at, _vector(LANES * CHANNELS))
        lines = builder.load(address, align=64)
        each = [
            builder.shuffle_vector(lines, lines, indices(range(k, LANES * CHANNELS, CHANNELS)))
            for k in range(CHANNELS)
        ]
        return context.make_tuple(builder, sig.return_type, each)

    return types.UniTuple(floats, CHANNELS)(pixels, at), emit


@intrinsic
def store_places(typing_context, places, at, row, column, line):
    """Write to ``places[at:]`` (int32) where pixels lie, of vectors of whole rows and columns."""

    def emit(context, builder, sig, args):
        integers = ir.VectorType(I32, LANES)
        row, column = (builder.fptosi(values, integers) for values in args[2:4])
        line = everywhere(builder, builder.trunc(args[4], I32), LANES)
        column = builder.mul(column, ir.Constant(integers, [CHANNELS] * LANES))
        target = pointer_to(context, builder, places, *args[:2], at, integers)
        builder.store(builder.add(builder.mul(row, line), column), target, align=4)
        return context.get_dummy_value()

    return types.void(places, at, floats, floats, types.intp), emit
