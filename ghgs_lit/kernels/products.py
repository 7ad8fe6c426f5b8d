"""Products of small matrices of float32 that stay in registers.

A tile of the result is ``ROWS`` x ``PANEL``; its right factor is a panel, ``PANEL`` numbers for every step of
the sum.
"""

from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic

from ghgs_lit.kernels.compile import processor_features
from ghgs_lit.kernels.memory import pointer_to
from ghgs_lit.kernels.simd import I64, LANES, call, constant, everywhere, floats

#: Rows and columns: 24 of the 32 registers of AVX-512, or 12 of the 16 of AVX2. They divide ``QUERIES`` and
#: ``WIDTH`` of ``layout``.
ROWS, PANEL = (12, 32) if "avx512f" in processor_features() else (6, 16)


def _steps(builder, rows, row_stride: int, step_stride: int, panel, steps, totals) -> None:
    """Add the products of each row and the panel, over ``steps`` numbers, to ``totals``."""
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
    """A product of ``ROWS`` rows and one panel. ``strides``: distances in numbers from row to row and from
    step to step; the compiler knows them, which keeps all registers free for the tile. ``adds``: add the
    product to ``out`` instead of overwriting it."""

    @intrinsic
    def product(typing_context, x, x_at, panels, panel_at, steps, out, out_at, out_stride):
        def emit(context, builder, sig, args):
            def place(k):
                return pointer_to(
                    context, builder, sig.args[k], args[k], args[k + 1], types.int64, ir.FloatType()
                )

            count = PANEL // LANES
            # These become registers, since their addresses never leave this function.
            totals = [[cgutils.alloca_once(builder, floats.llvm) for _ in range(count)] for _ in range(ROWS)]
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


#: ``out = x y`` where the numbers of all rows for one step are neighbours.
product = make_product((1, ROWS), adds=False)
