"""Numbers as 32-bit words: one float32, or two neighbouring bfloat16 with the first in the lower half.

Numba has no bfloat16, so arrays of bfloat16 are int32 arrays here.
"""

import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic, overload

from ghgs_lit.kernels.memory import pointer_to
from ghgs_lit.kernels.simd import I32, LANES, aligned, floats
from ghgs_lit.kernels.tile import PANEL


class _BFloat(ir.Type):
    """LLVM's type ``bfloat``, which llvmlite does not define."""

    def __str__(self) -> str:
        return "bfloat"

    def __eq__(self, other) -> bool:
        return isinstance(other, _BFloat)

    def __hash__(self) -> int:
        return hash(_BFloat)


PAIRS = ir.VectorType(_BFloat(), LANES * 2)


def holds_pairs(array) -> bool:
    """Whether an array of this Numba type holds pairs of bfloat16."""
    return array.dtype == types.int32


def per_word(array):
    """Numbers in one word of an array: 1 or 2, a constant for the compiler."""


@overload(per_word)
def _per_word(array):
    count = 2 if holds_pairs(array) else 1
    return lambda array: count


@intrinsic
def store_numbers(typing_context, array, index, value):
    """Write 16 floats from word ``index`` on: as 16 words, or rounded to bfloat16 as eight words."""
    half = holds_pairs(array)

    def emit(context, builder, sig, args):
        vector = args[2]
        if half:
            kind = ir.VectorType(_BFloat(), LANES)
            name = "llvm.x86.avx512bf16.cvtneps2bf16.512"
            callee = cgutils.get_or_insert_function(
                builder.module, ir.FunctionType(kind, [floats.llvm]), name
            )
            vector = builder.bitcast(builder.call(callee, [vector]), ir.VectorType(I32, LANES // 2))
        target = pointer_to(context, builder, array, *args[:2], index, vector.type)
        builder.store(vector, target, align=4)
        return context.get_dummy_value()

    return types.void(array, index, floats), emit


def _copy_row(rows, line, column, packed, at):
    for i in range(PANEL):
        packed[at + i] = rows[line, column + i] if line < len(rows) else 0


def _pair_rows(rows, line, column, packed, at):
    none = np.int32(0)
    for i in range(PANEL // 2):
        first = rows[2 * line, column // 2 + i] if 2 * line < len(rows) else none
        second = rows[2 * line + 1, column // 2 + i] if 2 * line + 1 < len(rows) else none
        packed[at + 2 * i] = (first & 0xFFFF) | (second << 16)
        packed[at + 2 * i + 1] = ((first >> 16) & 0xFFFF) | (second & -0x10000)


def aligned_words(array, count):
    """``count`` words of the array's type whose memory starts on a cache line."""


@overload(aligned_words)
def _aligned_words(array, count):
    if holds_pairs(array):
        return lambda array, count: aligned(count).view(np.int32)
    return lambda array, count: aligned(count)


def pack_line(rows, line, column, packed, at):
    """Copy ``PANEL`` columns of one row (bfloat16: of two rows, paired) to ``packed[at:]``.

    Rows after the last are zero.
    """


@overload(pack_line)
def _pack_line(rows, line, column, packed, at):
    return _pair_rows if holds_pairs(rows) else _copy_row
