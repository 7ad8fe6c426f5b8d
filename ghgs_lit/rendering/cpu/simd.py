"""Explicit vectors inside Numba kernels, lowered straight to LLVM vector instructions.

LLVM's loop vectoriser does not see through the masked inner loop of a rasterizer; explicit vectors do
not need it to. A vector is 64 bytes, 16 floats or 8 doubles: one AVX-512 register; on AVX2 and NEON LLVM
splits each operation into two or four of the machine's own, so the same kernels run everywhere. A mask
is one bit per lane. No fast-math flag is set: NaN and infinity behave as IEEE 754 says.
"""

import operator

import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, models, overload, register_model

from ghgs_lit.rendering.cpu import layout
from ghgs_lit.rendering.cpu.compile import helper

LANES = 16
DOUBLES = 8
_I32, _I64 = ir.IntType(32), ir.IntType(64)


class _Lanes(types.Type):
    """A Numba type that is one LLVM vector; it lives only inside kernels."""

    def __init__(self, name: str, element: ir.Type, count: int):
        self.count, self.element, self.llvm = count, element, ir.VectorType(element, count)
        super().__init__(name)


class _Floats(_Lanes):
    """Vectors of floating-point numbers."""


class _Mask(_Lanes):
    """One bit for each lane."""


floats = _Floats("float32x16", ir.FloatType(), LANES)
doubles = _Floats("float64x8", ir.DoubleType(), DOUBLES)
mask16 = _Mask("mask16", ir.IntType(1), LANES)
mask8 = _Mask("mask8", ir.IntType(1), DOUBLES)
_MASKS = {floats: mask16, doubles: mask8}
_VECTORS = {types.float32: floats, types.float64: doubles}
_SUFFIX = {floats: "v16f32", doubles: "v8f64"}


@register_model(_Floats)
@register_model(_Mask)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, manager, kind):
        super().__init__(manager, kind, kind.llvm)


def _operator(function, operand, result, emit):
    """Give a Python operator a meaning for two vectors or two masks."""

    class Template(AbstractTemplate):
        key = function

        def generic(self, args, keywords):
            return signature(result, operand, operand) if args == (operand, operand) else None

    infer_global(function)(Template)
    lower_builtin(function, operand, operand)(lambda context, builder, sig, args: emit(builder, *args))


for _kind, _mask in _MASKS.items():
    _operator(operator.add, _kind, _kind, lambda builder, a, b: builder.fadd(a, b))
    _operator(operator.sub, _kind, _kind, lambda builder, a, b: builder.fsub(a, b))
    _operator(operator.mul, _kind, _kind, lambda builder, a, b: builder.fmul(a, b))
    _operator(operator.truediv, _kind, _kind, lambda builder, a, b: builder.fdiv(a, b))
    _operator(operator.le, _kind, _mask, lambda builder, a, b: builder.fcmp_ordered("<=", a, b))
    _operator(operator.lt, _kind, _mask, lambda builder, a, b: builder.fcmp_ordered("<", a, b))
    _operator(operator.gt, _kind, _mask, lambda builder, a, b: builder.fcmp_ordered(">", a, b))
    _operator(operator.ge, _kind, _mask, lambda builder, a, b: builder.fcmp_ordered(">=", a, b))
    _operator(operator.eq, _kind, _mask, lambda builder, a, b: builder.fcmp_ordered("==", a, b))
    _operator(operator.and_, _mask, _mask, lambda builder, a, b: builder.and_(a, b))


def _constant(kind, value: float):
    return ir.Constant(kind.llvm, [value] * kind.count)


def _call(builder, name, kind, *args):
    """Call an LLVM intrinsic whose arguments and result are all of one kind of vector."""
    function = ir.FunctionType(kind.llvm, [kind.llvm] * len(args))
    callee = cgutils.get_or_insert_function(builder.module, function, f"llvm.{name}.{_SUFFIX[kind]}")
    return builder.call(callee, args)


def _indices(values):
    values = list(values)
    return ir.Constant(ir.VectorType(_I32, len(values)), values)


@intrinsic
def full(typing_context, value):
    """A float32 or float64 in every lane; other numbers become float64."""
    scalar = types.float32 if value == types.float32 else types.float64
    kind = _VECTORS[scalar]

    def emit(context, builder, sig, args):
        undefined = ir.Constant(kind.llvm, ir.Undefined)
        number = context.cast(builder, args[0], value, scalar)
        one = builder.insert_element(undefined, number, ir.Constant(_I32, 0))
        return builder.shuffle_vector(one, undefined, _indices([0] * kind.count))

    return kind(value), emit


@intrinsic
def lane_columns(typing_context):
    """Column of each lane in a 4 x 4 block: 0 1 2 3 0 1 2 3 ..."""
    values = [float(i % 4) for i in range(LANES)]
    return floats(), lambda context, builder, sig, args: ir.Constant(floats.llvm, values)


@intrinsic
def lane_rows(typing_context):
    """Row of each lane in a 4 x 4 block: 0 0 0 0 1 1 1 1 ..."""
    values = [float(i // 4) for i in range(LANES)]
    return floats(), lambda context, builder, sig, args: ir.Constant(floats.llvm, values)


def _pointer(context, builder, array_type, array, index, index_type):
    """Address of element ``index`` of a contiguous array as one of a vector, and its alignment.

    Vectors of floats are read and written where a cache line begins, vectors of doubles anywhere.
    """
    kind = _VECTORS[array_type.dtype]
    data = context.make_array(array_type)(context, builder, array).data
    position = context.cast(builder, index, index_type, types.intp)
    address = builder.bitcast(builder.gep(data, [position]), kind.llvm.as_pointer())
    return address, 64 if kind is floats else 8


@intrinsic
def load(typing_context, array, index):
    """The vector that starts at ``array[index]`` of a contiguous, one-dimensional array."""

    def emit(context, builder, sig, args):
        address, align = _pointer(context, builder, array, *args, index)
        return builder.load(address, align=align)

    return _VECTORS[array.dtype](array, index), emit


@intrinsic
def store(typing_context, array, index, value):
    """Write a vector to ``array[index]`` and after; alignment as for ``load``."""

    def emit(context, builder, sig, args):
        address, align = _pointer(context, builder, array, *args[:2], index)
        builder.store(args[2], address, align=align)
        return context.get_dummy_value()

    return types.void(array, index, value), emit


@intrinsic
def prefetch(typing_context, array, index):
    """Ask for the cache line of element ``index`` of a contiguous array, counted in its flat order."""

    def emit(context, builder, sig, args):
        data = context.make_array(array)(context, builder, args[0]).data
        position = context.cast(builder, args[1], index, types.intp)
        kind = ir.FunctionType(ir.VoidType(), [ir.IntType(8).as_pointer(), _I32, _I32, _I32])
        callee = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0i8")
        address = builder.bitcast(builder.gep(data, [position]), ir.IntType(8).as_pointer())
        # For reading, into all levels, as data.
        builder.call(callee, [address, ir.Constant(_I32, 0), ir.Constant(_I32, 3), ir.Constant(_I32, 1)])
        return context.get_dummy_value()

    return types.void(array, index), emit


@intrinsic
def fma(typing_context, a, b, c):
    """``a * b + c``, fused where the machine can."""
    return a(a, a, a), lambda context, builder, sig, args: _call(builder, "fmuladd", a, *args)


@intrinsic
def root(typing_context, a):
    """Square root, lane by lane; NaN of negative numbers."""
    return a(a), lambda context, builder, sig, args: _call(builder, "sqrt", a, *args)


@intrinsic
def floor(typing_context, a):
    """The largest whole number that is not larger, lane by lane."""
    return a(a), lambda context, builder, sig, args: _call(builder, "floor", a, *args)


@intrinsic
def minimum(typing_context, a, b):
    """The smaller of two numbers, lane by lane; ``b`` where either is NaN."""

    def emit(context, builder, sig, args):
        return builder.select(builder.fcmp_ordered("<", *args), *args)

    return a(a, a), emit


@intrinsic
def maximum(typing_context, a, b):
    """The larger of two numbers, lane by lane; ``b`` where either is NaN."""

    def emit(context, builder, sig, args):
        return builder.select(builder.fcmp_ordered(">", *args), *args)

    return a(a, a), emit


@intrinsic
def select(typing_context, where, a, b):
    """``a`` in the lanes of the mask, ``b`` in the others."""
    return a(where, a, a), lambda context, builder, sig, args: builder.select(*args)


@intrinsic
def bits(typing_context, where):
    """The mask as an integer, lane 0 in bit 0."""

    def emit(context, builder, sig, args):
        return builder.zext(builder.bitcast(args[0], ir.IntType(where.count)), _I64)

    return types.int64(where), emit


@intrinsic
def trailing_zeros(typing_context, value):
    """Index of the lowest set bit of a non-zero int64."""

    def emit(context, builder, sig, args):
        return builder.cttz(args[0], ir.Constant(ir.IntType(1), 1))

    return types.int64(types.int64), emit


# 2^f on [-1/2, 1/2], exact at 0: minimax in relative error, 7e-8.
_EXP2 = (1.0, 0.69314660, 0.24022166, 0.055510474, 0.0096749520, 0.0013202982)


@intrinsic
def exp2_minus(typing_context, x):
    """``2^-x`` of floats for ``0 <= x <= 126``, within 2 ulp."""

    def emit(context, builder, sig, args):
        whole = _call(builder, "rint", floats, args[0])
        part = builder.fsub(whole, args[0])
        result = _constant(floats, _EXP2[-1])
        for coefficient in _EXP2[-2::-1]:
            result = _call(builder, "fmuladd", floats, result, part, _constant(floats, coefficient))
        integers = ir.VectorType(_I32, LANES)
        shift = builder.shl(builder.fptosi(whole, integers), _indices([23] * LANES))
        return builder.bitcast(builder.sub(builder.bitcast(result, integers), shift), floats.llvm)

    return floats(floats), emit


def _fold(builder, first, second, width):
    """Add the two halves of every group of ``width`` lanes of two vectors into one vector."""
    low = [i for i in range(2 * LANES) if i % width < width // 2]
    high = [i + width // 2 for i in low]
    return builder.fadd(
        builder.shuffle_vector(first, second, _indices(low)),
        builder.shuffle_vector(first, second, _indices(high)),
    )


@intrinsic
def row_sums(typing_context, array, index, count):
    """Sums of the 16 rows of 16 floats from ``index`` on: row ``k``'s in lane ``k``, by a fixed tree.

    Where ``count`` is a tuple, rows from ``COLOR + len(count)`` on are taken for zero.
    """
    used = layout.COLOR + len(count) if isinstance(count, types.BaseTuple) else LANES

    def emit(context, builder, sig, args):
        rows = []
        for k in range(min(used, LANES)):
            position = builder.add(args[1], ir.Constant(args[1].type, k * LANES))
            address, align = _pointer(context, builder, array, args[0], position, index)
            rows.append(builder.load(address, align=align))
        rows += [_constant(floats, 0.0)] * (LANES - len(rows))
        width = LANES
        while len(rows) > 1:
            rows = [_fold(builder, a, b, width) for a, b in zip(rows[::2], rows[1::2], strict=True)]
            width //= 2
        return rows[0]

    return floats(array, index, count), emit


def _block_rows(context, builder, array_type, array, index, stride, index_type):
    """Addresses of the four rows of four floats of a block whose first pixel is ``array[index]``."""
    data = context.make_array(array_type)(context, builder, array).data
    position, step = (context.cast(builder, value, index_type, types.intp) for value in (index, stride))
    kind = ir.VectorType(ir.FloatType(), 4).as_pointer()
    addresses = []
    for _ in range(4):
        addresses.append(builder.bitcast(builder.gep(data, [position]), kind))
        position = builder.add(position, step)
    return addresses


@intrinsic
def load_block(typing_context, array, index, stride):
    """The 4 x 4 pixels of a flat image that start at ``index``; its rows are ``stride`` floats apart."""

    def emit(context, builder, sig, args):
        rows = _block_rows(context, builder, array, *args, index)
        a, b, c, d = (builder.load(row, align=4) for row in rows)
        upper, lower = (builder.shuffle_vector(x, y, _indices(range(8))) for x, y in ((a, b), (c, d)))
        return builder.shuffle_vector(upper, lower, _indices(range(16)))

    return floats(array, index, index), emit


@intrinsic
def store_block(typing_context, array, index, stride, value):
    """Write a vector to 4 x 4 pixels of a flat image."""

    def emit(context, builder, sig, args):
        for k, row in enumerate(_block_rows(context, builder, array, *args[:3], index)):
            part = builder.shuffle_vector(args[3], args[3], _indices(range(4 * k, 4 * k + 4)))
            builder.store(part, row, align=4)
        return context.get_dummy_value()

    return types.void(array, index, index, value), emit


def length(values):
    """``len(values)``, known to the compiler when it is a tuple; an integer stands for itself."""


@overload(length)
def _length(values):
    if isinstance(values, types.BaseTuple):
        count = len(values)
        return lambda values: count
    return lambda values: values


@helper
def aligned(count):
    """``count`` floats whose memory starts on a cache line."""
    buffer = np.empty(count + LANES, np.float32)
    skip = (-(buffer.ctypes.data // 4)) % LANES
    return buffer[skip : skip + count]
