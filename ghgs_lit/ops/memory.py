"""Vector loads and stores inside Numba kernels.

Kernels call functions decorated with ``@intrinsic`` without their first parameter, Numba's
``typing_context``; ``emit(context, builder, sig, args)`` writes their LLVM instructions.
"""

from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic

from ghgs_lit.ops.simd import I32, floats, vector_of


def pointer_to(context, builder, array_type, array, index, index_type, kind):
    """Pointer to a vector at an element of a contiguous array.

    Args:
        context: Numba's target context.
        builder: LLVM IR builder.
        array_type: Numba type of the array.
        array: LLVM value of the array.
        index: flat index of the element, an LLVM integer.
        index_type: Numba type of ``index``.
        kind: LLVM type of the vector.
    """
    data = context.make_array(array_type)(context, builder, array).data
    position = context.cast(builder, index, index_type, types.intp)
    return builder.bitcast(builder.gep(data, [position]), kind.as_pointer())


def _make_access(alignment_of):
    """Make intrinsics that load and store vectors; ``alignment_of`` maps a vector type to bytes."""

    @intrinsic
    def load(typing_context, array, index):
        """Load the vector that starts at ``array[index]`` of a contiguous, one-dimensional array."""
        kind = vector_of(array.dtype)

        def emit(context, builder, sig, args):
            address = pointer_to(context, builder, array, *args, index, kind.llvm)
            return builder.load(address, align=alignment_of(kind))

        return kind(array, index), emit

    @intrinsic
    def store(typing_context, array, index, value):
        """Write a vector to ``array[index]`` and the elements that follow.

        Args:
            typing_context: Numba's.
            array: contiguous, one-dimensional, float32 or float64.
            index: index of the first element.
            value: a vector, or a number for all lanes.
        """
        kind = vector_of(array.dtype)

        def emit(context, builder, sig, args):
            address = pointer_to(context, builder, array, *args[:2], index, kind.llvm)
            builder.store(args[2], address, align=alignment_of(kind))
            return context.get_dummy_value()

        return types.void(array, index, kind), emit

    return load, store


# ``load`` and ``store`` require that vectors of floats start on a cache line; ``store_anywhere``
# accepts any address.
load, store = _make_access(lambda kind: 64 if kind is floats else 8)
_, store_anywhere = _make_access(lambda kind: 4 if kind is floats else 8)


@intrinsic
def prefetch(typing_context, array, index):
    """Prefetch the cache line of element ``index`` (flat index) of a contiguous array."""

    def emit(context, builder, sig, args):
        byte = ir.IntType(8).as_pointer()
        kind = ir.FunctionType(ir.VoidType(), [byte, I32, I32, I32])
        callee = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0i8")
        address = pointer_to(context, builder, array, *args, index, ir.IntType(8))
        # For reading, into all cache levels, as data.
        builder.call(callee, [address, ir.Constant(I32, 0), ir.Constant(I32, 3), ir.Constant(I32, 1)])
        return context.get_dummy_value()

    return types.void(array, index), emit
