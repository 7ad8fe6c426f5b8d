"""Products of small matrices that stay in registers, in float32 or in pairs of bfloat16.

Both factors are 32-bit words (see ``bfloat16``). A pair holds neighbours along the dimension that is summed,
which is what AVX-512's bfloat16 product needs; it sums in float32. A tile of the result is ``ROWS`` x
``PANEL``; its right factor is a panel, ``PANEL`` words for every step of the sum.
"""

from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic

from ghgs_lit.kernels.bfloat16 import PAIRS, holds_pairs
from ghgs_lit.kernels.memory import pointer_to
from ghgs_lit.kernels.simd import I32, I64, LANES, call, constant, everywhere, floats
from ghgs_lit.kernels.tile import PANEL, ROWS

_WORDS = ir.VectorType(I32, LANES)


def _multiply_add(builder, half: bool, x, y, total):
    """``total + x * y`` in every lane; with ``half``, the products of both bfloat16 of a lane are added."""
    if not half:
        return call(builder, "fmuladd", floats, x, y, total)
    kind = ir.FunctionType(floats.llvm, [floats.llvm, PAIRS, PAIRS])
    callee = cgutils.get_or_insert_function(builder.module, kind, "llvm.x86.avx512bf16.dpbf16ps.512")
    return builder.call(callee, [total, builder.bitcast(x, PAIRS), builder.bitcast(y, PAIRS)])


def _steps(builder, half: bool, rows, row_stride: int, step_stride: int, panel, steps, totals) -> None:
    """Add the products of each row and the panel, over ``steps`` words, to ``totals``."""
    kind = _WORDS if half else floats.llvm
    with cgutils.for_range(builder, steps, intp=I64) as loop:
        line = builder.gep(panel, [builder.mul(loop.index, ir.Constant(I64, PANEL))])
        parts = []
        for j in range(PANEL // LANES):
            place = builder.gep(line, [ir.Constant(I64, LANES * j)])
            parts.append(builder.load(builder.bitcast(place, kind.as_pointer()), align=64))
        first = builder.gep(rows, [builder.mul(loop.index, ir.Constant(I64, step_stride))])
        for r in range(ROWS):
            word = builder.load(builder.gep(first, [ir.Constant(I64, row_stride * r)]))
            x = everywhere(builder, word, LANES)
            for part, total in zip(parts, totals[r], strict=True):
                builder.store(_multiply_add(builder, half, x, part, builder.load(total)), total)


def make_product(strides, adds: bool):
    """A product of ``ROWS`` rows and one panel.

    Args:
        strides: maps ``half`` to the distances in words from row to row and from step to step; the compiler
            knows them, which keeps all registers free for the tile.
        adds: add the product to ``out`` instead of overwriting it.
    """

    @intrinsic
    def product(typing_context, x, x_at, panels, panel_at, steps, out, out_at, out_stride):
        half = holds_pairs(x)
        row_stride, step_stride = strides(half)

        def emit(context, builder, sig, args):
            def place(k, kind):
                return pointer_to(context, builder, sig.args[k], args[k], args[k + 1], types.int64, kind)

            word = I32 if half else ir.FloatType()
            count = PANEL // LANES
            # These become registers, since their addresses never leave this function.
            totals = [[cgutils.alloca_once(builder, floats.llvm) for _ in range(count)] for _ in range(ROWS)]
            for row in totals:
                for total in row:
                    builder.store(constant(floats, 0.0), total)
            _steps(builder, half, place(0, word), row_stride, step_stride, place(2, word), args[4], totals)
            first = place(5, ir.FloatType())
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


#: ``out = x y`` where the words of all rows for one step are neighbours.
product = make_product(lambda half: (1, ROWS), adds=False)
