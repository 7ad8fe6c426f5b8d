"""Vectors of 16 floats inside Numba kernels, lowered straight to LLVM vector instructions.

LLVM's loop vectoriser does not see through the masked inner loop of a rasterizer; explicit vectors do
not need it to. Sixteen lanes are one AVX-512 register; on AVX2 and NEON LLVM splits each operation into
two or four of the machine's own, so the same kernels run everywhere. ``Mask`` is one bit per lane.
No fast-math flag is set anywhere: NaN and infinity behave as IEEE 754 says.
"""

import operator

from llvmlite import ir
from numba.core import cgutils, types
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, models, register_model

LANES = 16
_FLOATS = ir.VectorType(ir.FloatType(), LANES)
_INTS = ir.VectorType(ir.IntType(32), LANES)
_BITS = ir.VectorType(ir.IntType(1), LANES)
_BITMAP = ir.IntType(LANES)


class _Vector(types.Type):
    """A Numba type that is one LLVM vector; it lives only inside kernels."""


vector = _Vector("float32x16")


class _MaskType(types.Type):
    """One bit for each lane."""


mask = _MaskType("mask16")


@register_model(_Vector)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, manager, kind):
        super().__init__(manager, kind, _FLOATS)


@register_model(_MaskType)
class _MaskModel(models.PrimitiveModel):
    def __init__(self, manager, kind):
        super().__init__(manager, kind, _BITS)


def _operator(function, operand, result, emit):
    """Give a Python operator a meaning for two vectors or two masks."""

    class Template(AbstractTemplate):
        key = function

        def generic(self, args, keywords):
            return signature(result, operand, operand) if args == (operand, operand) else None

    infer_global(function)(Template)
    lower_builtin(function, operand, operand)(lambda context, builder, sig, args: emit(builder, *args))


_operator(operator.add, vector, vector, lambda builder, a, b: builder.fadd(a, b))
_operator(operator.sub, vector, vector, lambda builder, a, b: builder.fsub(a, b))
_operator(operator.mul, vector, vector, lambda builder, a, b: builder.fmul(a, b))
_operator(operator.truediv, vector, vector, lambda builder, a, b: builder.fdiv(a, b))
_operator(operator.le, vector, mask, lambda builder, a, b: builder.fcmp_ordered("<=", a, b))
_operator(operator.lt, vector, mask, lambda builder, a, b: builder.fcmp_ordered("<", a, b))
_operator(operator.gt, vector, mask, lambda builder, a, b: builder.fcmp_ordered(">", a, b))
_operator(operator.and_, mask, mask, lambda builder, a, b: builder.and_(a, b))


def _splat(builder, scalar, kind=_FLOATS):
    """The same scalar in every lane."""
    one = builder.insert_element(ir.Constant(kind, ir.Undefined), scalar, ir.Constant(ir.IntType(32), 0))
    zeros = ir.Constant(ir.VectorType(ir.IntType(32), LANES), None)
    return builder.shuffle_vector(one, ir.Constant(kind, ir.Undefined), zeros)


def _call(builder, name, *args):
    """Call an LLVM intrinsic whose arguments and result are float vectors."""
    kind = ir.FunctionType(_FLOATS, [_FLOATS] * len(args))
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, f"llvm.{name}.v16f32"), args)


def _constant(values, kind=_FLOATS):
    return ir.Constant(kind, list(values))


@intrinsic
def full(typing_context, value):
    """A float32 in every lane."""

    def emit(context, builder, sig, args):
        return _splat(builder, context.cast(builder, args[0], value, types.float32))

    return vector(value), emit


@intrinsic
def lane_columns(typing_context):
    """Column of each lane in a 4 x 4 block: 0 1 2 3 0 1 2 3 ..."""
    return vector(), lambda context, builder, sig, args: _constant(float(i % 4) for i in range(LANES))


@intrinsic
def lane_rows(typing_context):
    """Row of each lane in a 4 x 4 block: 0 0 0 0 1 1 1 1 ..."""
    return vector(), lambda context, builder, sig, args: _constant(float(i // 4) for i in range(LANES))


def _pointer(context, builder, array_type, array, index):
    data = context.make_array(array_type)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [index]), _FLOATS.as_pointer())


@intrinsic
def load(typing_context, array, index):
    """The 16 floats from ``index`` on of a contiguous float32 array whose memory is 64-byte aligned there."""

    def emit(context, builder, sig, args):
        position = context.cast(builder, args[1], index, types.intp)
        return builder.load(_pointer(context, builder, array, args[0], position), align=64)

    return vector(array, index), emit


@intrinsic
def store(typing_context, array, index, value):
    """Write 16 floats from ``index`` on; alignment as for ``load``."""

    def emit(context, builder, sig, args):
        position = context.cast(builder, args[1], index, types.intp)
        builder.store(args[2], _pointer(context, builder, array, args[0], position), align=64)
        return context.get_dummy_value()

    return types.void(array, index, vector), emit


@intrinsic
def fma(typing_context, a, b, c):
    """``a * b + c``, fused where the machine can."""
    return vector(vector, vector, vector), lambda context, builder, sig, args: _call(
        builder, "fmuladd", *args
    )


@intrinsic
def minimum(typing_context, a, b):
    """The smaller of two numbers, lane by lane; ``b`` where ``a`` is NaN."""

    def emit(context, builder, sig, args):
        return builder.select(builder.fcmp_ordered("<", *args), *args)

    return vector(vector, vector), emit


@intrinsic
def select(typing_context, where, a, b):
    """``a`` in the lanes of the mask, ``b`` in the others."""
    return vector(mask, vector, vector), lambda context, builder, sig, args: builder.select(*args)


@intrinsic
def bits(typing_context, where):
    """The mask as an integer, lane 0 in bit 0."""

    def emit(context, builder, sig, args):
        return builder.zext(builder.bitcast(args[0], _BITMAP), ir.IntType(64))

    return types.int64(mask), emit


@intrinsic
def trailing_zeros(typing_context, value):
    """Index of the lowest set bit of a non-zero int64."""

    def emit(context, builder, sig, args):
        return builder.cttz(args[0], ir.Constant(ir.IntType(1), 1))

    return types.int64(types.int64), emit


# 2^f on [-1/2, 1/2], exact at 0: minimax in relative error, 7e-8.
_EXP2 = (1.0, 0.69314660, 0.24022166, 0.055510474, 0.0096749520, 0.0013202982)


@intrinsic
def exp2(typing_context, x):
    """``2^x`` for ``-126 <= x <= 127``, within 2 ulp."""

    def emit(context, builder, sig, args):
        whole = _call(builder, "rint", args[0])
        part = builder.fsub(args[0], whole)
        result = _constant([_EXP2[-1]] * LANES)
        for coefficient in _EXP2[-2::-1]:
            result = _call(builder, "fmuladd", result, part, _constant([coefficient] * LANES))
        shift = builder.shl(builder.fptosi(whole, _INTS), _constant([23] * LANES, _INTS))
        return builder.bitcast(builder.add(builder.bitcast(result, _INTS), shift), _FLOATS)

    return vector(vector), emit


def _fold(builder, first, second, width):
    """Add the two halves of every group of ``width`` lanes of two vectors into one vector."""
    low = [i for i in range(2 * LANES) if i % width < width // 2]
    high = [i + width // 2 for i in low]
    return builder.fadd(
        builder.shuffle_vector(first, second, _constant(low, _INTS)),
        builder.shuffle_vector(first, second, _constant(high, _INTS)),
    )


@intrinsic
def row_sums(typing_context, array, index):
    """Sums of the 16 rows of 16 floats from ``index`` on: row ``k``'s in lane ``k``, by a fixed tree."""

    def emit(context, builder, sig, args):
        start = context.cast(builder, args[1], index, types.intp)
        rows = []
        for k in range(LANES):
            position = builder.add(start, ir.Constant(start.type, k * LANES))
            rows.append(builder.load(_pointer(context, builder, array, args[0], position), align=64))
        width = LANES
        while len(rows) > 1:
            rows = [_fold(builder, a, b, width) for a, b in zip(rows[::2], rows[1::2], strict=True)]
            width //= 2
        return rows[0]

    return vector(array, index), emit
