"""Explicit vectors inside Numba kernels, compiled directly to LLVM vector instructions.

LLVM cannot vectorise the masked inner loop of a rasterizer. A vector has 64 bytes, 16 floats or 8
doubles: one AVX-512 register; for AVX2 and NEON, LLVM splits each operation into two or four. A mask
is one bit per lane. No fast-math flag is set: NaN and infinity behave as in IEEE 754. A number that
is combined with a vector is broadcast to every lane. :mod:`ghgs_lit.ops.memory` loads and stores
vectors.

Kernels call functions decorated with ``@intrinsic`` without their first parameter, Numba's
``typing_context``; ``emit(context, builder, sig, args)`` writes their LLVM instructions.
"""

import math
import operator

import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, lower_cast, models, register_model

from ghgs_lit.ops.compile import helper

LANES = 16
DOUBLES = 8
I32 = ir.IntType(32)
I64 = ir.IntType(64)


class _Lanes(types.Type):
    """A Numba type for an LLVM vector, which exists only inside kernels."""

    def __init__(self, name: str, element: ir.Type, count: int):
        self.count = count
        self.element = element
        self.llvm = ir.VectorType(element, count)
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
_SCALARS = {floats: types.float32, doubles: types.float64}
_VECTORS = {scalar: kind for kind, scalar in _SCALARS.items()}
_SUFFIX = {floats: "v16f32", doubles: "v8f64"}


@register_model(_Floats)
@register_model(_Mask)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, manager, kind):
        super().__init__(manager, kind, kind.llvm)


def everywhere(builder, number, count: int):
    """Broadcast a number, an LLVM value, to a vector of ``count`` lanes."""
    undefined = ir.Constant(ir.VectorType(number.type, count), ir.Undefined)
    one = builder.insert_element(undefined, number, ir.Constant(I32, 0))
    return builder.shuffle_vector(one, undefined, indices([0] * count))


@lower_cast(types.Number, _Floats)
def _fill(context, builder, source, kind, value):
    """Cast a number to a vector by broadcasting it to every lane."""
    return everywhere(builder, context.cast(builder, value, source, _SCALARS[kind]), kind.count)


def _common(*args):
    """The vector type of the arguments; None if there is none or more than one."""
    kinds = {a for a in args if isinstance(a, _Lanes)}
    fits = len(kinds) == 1 and all(isinstance(a, (_Lanes, types.Number)) for a in args)
    return kinds.pop() if fits else None


def _operator(function, family, result, emit):
    """Define a Python operator, such as ``operator.add``, for vectors.

    Args:
        function: the operator.
        family: class of the operands.
        result: maps the type of the operands to the type of the result.
        emit: writes the instruction, given a builder and two operands.
    """

    class Template(AbstractTemplate):
        key = function
        # Numba tries templates of this target before its own, of which each operator has dozens.
        metadata = {"target": "cpu"}  # noqa: RUF012

        def generic(self, args, keywords):
            kind = _common(*args)
            return signature(result(kind), kind, kind) if isinstance(kind, family) else None

    infer_global(function)(Template)
    lower_builtin(function, family, family)(lambda context, builder, sig, args: emit(builder, *args))


def _compare(function, sign):
    _operator(function, _Floats, _MASKS.get, lambda builder, a, b: builder.fcmp_ordered(sign, a, b))


_operator(operator.add, _Floats, lambda kind: kind, lambda builder, a, b: builder.fadd(a, b))
_operator(operator.sub, _Floats, lambda kind: kind, lambda builder, a, b: builder.fsub(a, b))
_operator(operator.mul, _Floats, lambda kind: kind, lambda builder, a, b: builder.fmul(a, b))
_operator(operator.truediv, _Floats, lambda kind: kind, lambda builder, a, b: builder.fdiv(a, b))
_operator(operator.and_, _Mask, lambda kind: kind, lambda builder, a, b: builder.and_(a, b))
_compare(operator.le, "<=")
_compare(operator.lt, "<")
_compare(operator.gt, ">")
_compare(operator.ge, ">=")
_compare(operator.eq, "==")


def constant(kind, value: float):
    """Constant LLVM vector of a type with ``value`` in every lane."""
    return ir.Constant(kind.llvm, [value] * kind.count)


def call(builder, name, kind, *args):
    """Call an LLVM intrinsic whose arguments and result are vectors of one type.

    Args:
        builder: LLVM IR builder.
        name: name of the intrinsic without ``llvm.`` and types, such as ``fmuladd``.
        kind: Numba type of the vectors.
        args: LLVM values.
    """
    function = ir.FunctionType(kind.llvm, [kind.llvm] * len(args))
    callee = cgutils.get_or_insert_function(builder.module, function, f"llvm.{name}.{_SUFFIX[kind]}")
    return builder.call(callee, args)


def indices(values):
    """Constant vector of lane indices for LLVM's ``shufflevector``."""
    values = list(values)
    return ir.Constant(ir.VectorType(I32, len(values)), values)


def vector_of(scalar):
    """Vector type with lanes of float32 or float64."""
    return _VECTORS[scalar]


@intrinsic
def full(typing_context, value):
    """Broadcast a float32 or float64 to a vector; other numbers become float64."""
    kind = floats if value == types.float32 else doubles
    return kind(kind), lambda context, builder, sig, args: args[0]


@intrinsic
def fma(typing_context, a, b, c):
    """Compute ``a * b + c``, fused where the processor has an instruction for it.

    Args:
        typing_context: Numba's.
        a: a vector, or a number for every lane.
        b: a vector, or a number for every lane.
        c: a vector, or a number for every lane; at least one of the three is a vector.
    """
    kind = _common(a, b, c)
    return kind(kind, kind, kind), lambda context, builder, sig, args: call(builder, "fmuladd", kind, *args)


@intrinsic
def sqrt(typing_context, a):
    """Square root of each lane; NaN for negative numbers."""
    return a(a), lambda context, builder, sig, args: call(builder, "sqrt", a, *args)


@intrinsic
def floor(typing_context, a):
    """Each lane rounded down to a whole number."""
    return a(a), lambda context, builder, sig, args: call(builder, "floor", a, *args)


def _make_extreme(sign: str):
    @intrinsic
    def extreme(typing_context, a, b):
        """The smaller or larger number in each lane; ``b`` where either is NaN."""

        def emit(context, builder, sig, args):
            return builder.select(builder.fcmp_ordered(sign, *args), *args)

        kind = _common(a, b)
        return kind(kind, kind), emit

    return extreme


minimum = _make_extreme("<")
maximum = _make_extreme(">")


@intrinsic
def select(typing_context, where, a, b):
    """``a`` in the lanes where the mask is set, ``b`` in the others.

    Args:
        typing_context: Numba's.
        where: a mask.
        a: a vector, or a number for every lane.
        b: a vector, or a number for every lane; at least one of the two is a vector.
    """
    kind = _common(a, b)
    return kind(where, kind, kind), lambda context, builder, sig, args: builder.select(*args)


@intrinsic
def bits(typing_context, where):
    """Convert a mask to an integer, lane 0 in bit 0."""

    def emit(context, builder, sig, args):
        return builder.zext(builder.bitcast(args[0], ir.IntType(where.count)), I64)

    return types.int64(where), emit


@intrinsic
def mask(typing_context, bits):
    """Convert an integer to a mask of eight lanes, lane 0 in bit 0."""

    def emit(context, builder, sig, args):
        return builder.bitcast(builder.trunc(args[0], ir.IntType(DOUBLES)), mask8.llvm)

    return mask8(types.int64), emit


@intrinsic
def lane_sum(typing_context, x):
    """Sum of all lanes of floats, adding the upper half to the lower half until one lane is left."""

    def emit(context, builder, sig, args):
        total = args[0]
        width = LANES
        while width > 1:
            width //= 2
            low, high = (indices(range(k, k + width)) for k in (0, width))
            halves = (builder.shuffle_vector(total, total, lanes) for lanes in (low, high))
            total = builder.fadd(*halves)
        return builder.extract_element(total, ir.Constant(I32, 0))

    return types.float32(floats), emit


@intrinsic
def lane_max(typing_context, x):
    """The largest lane of floats; NaN is ignored."""

    def emit(context, builder, sig, args):
        kind = ir.FunctionType(ir.FloatType(), [floats.llvm])
        callee = cgutils.get_or_insert_function(builder.module, kind, "llvm.vector.reduce.fmax.v16f32")
        return builder.call(callee, args)

    return types.float32(floats), emit


@intrinsic
def trailing_zeros(typing_context, value):
    """Index of the lowest set bit of a non-zero int64."""

    def emit(context, builder, sig, args):
        return builder.cttz(args[0], ir.Constant(ir.IntType(1), 1))

    return types.int64(types.int64), emit


# Polynomial of 2^f on [-1/2, 1/2], exact at 0, with the smallest maximal relative error: 7e-8.
_EXP2 = (1.0, 0.69314660, 0.24022166, 0.055510474, 0.0096749520, 0.0013202982)
#: 2^-126 is the smallest normal float32.
EXP2_LIMIT = np.float32(126)


@intrinsic
def exp2_minus(typing_context, x):
    """Compute ``2^-x`` of floats for ``0 <= x <= EXP2_LIMIT``, within 2 ulp."""

    def emit(context, builder, sig, args):
        whole = call(builder, "rint", floats, args[0])
        part = builder.fsub(whole, args[0])
        result = constant(floats, _EXP2[-1])
        for coefficient in _EXP2[-2::-1]:
            result = call(builder, "fmuladd", floats, result, part, constant(floats, coefficient))
        integers = ir.VectorType(I32, LANES)
        shift = builder.shl(builder.fptosi(whole, integers), indices([23] * LANES))
        return builder.bitcast(builder.sub(builder.bitcast(result, integers), shift), floats.llvm)

    return floats(floats), emit


_ZERO = np.float32(0)
_ONE = np.float32(1)
_TWICE = np.float32(2 * math.log2(math.e))


@helper
def tanh(x):
    """Hyperbolic tangent of floats, within 1e-7; NaN stays NaN."""
    distance = maximum(x, _ZERO - x)
    shrunk = exp2_minus(minimum(full(EXP2_LIMIT), distance * _TWICE))
    size = (_ONE - shrunk) / (_ONE + shrunk)
    return select(x < _ZERO, _ZERO - size, size)


# log2(m) = 2 / ln 2 (s + s^3 / 3 + s^5 / 5 + ...), s = (m - 1) / (m + 1): 1e-14 for m in [1/sqrt 2,
# sqrt 2).
_LOG2 = [2 / math.log(2) / k for k in range(1, 19, 2)]
# Subtracted from the bits of x, so that the mantissa lies in [1/sqrt 2, sqrt 2).
_ROOT_HALF = int(np.float64(math.sqrt(0.5)).view(np.int64))


@intrinsic
def log2(typing_context, x):
    """Binary logarithm of positive, normal doubles, within 1e-13; undefined for other numbers."""

    def emit(context, builder, sig, args):
        integers = ir.VectorType(I64, DOUBLES)
        number = builder.bitcast(args[0], integers)
        shift = ir.Constant(integers, [52] * DOUBLES)
        offset = builder.sub(number, ir.Constant(integers, [_ROOT_HALF] * DOUBLES))
        exponent = builder.ashr(offset, shift)
        mantissa = builder.bitcast(builder.sub(number, builder.shl(exponent, shift)), doubles.llvm)
        one = constant(doubles, 1.0)
        s = builder.fdiv(builder.fsub(mantissa, one), builder.fadd(mantissa, one))
        squared = builder.fmul(s, s)
        result = constant(doubles, _LOG2[-1])
        for coefficient in _LOG2[-2::-1]:
            result = call(builder, "fmuladd", doubles, result, squared, constant(doubles, coefficient))
        return call(builder, "fmuladd", doubles, result, s, builder.sitofp(exponent, doubles.llvm))

    return doubles(doubles), emit


def aligned_floats(count):
    """Allocate ``count`` uninitialised floats aligned to a cache line."""
    buffer = np.empty(count + LANES, np.float32)
    skip = (-(buffer.ctypes.data // 4)) % LANES
    return buffer[skip : skip + count]


#: :func:`aligned_floats` inside kernels.
aligned = helper(aligned_floats)
