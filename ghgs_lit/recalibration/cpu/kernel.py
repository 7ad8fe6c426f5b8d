"""Attention of tokens over their neighbours (paper, Eqs. 3 to 5), one token at a time."""

import math
from functools import cache

import numpy as np
from numba.core import types

from ghgs_lit.kernels import memory, simd
from ghgs_lit.kernels.compile import helper, kernel_for
from ghgs_lit.kernels.simd import EXP2_LIMIT

LANES = simd.LANES
LOWEST = np.float32(-np.inf)

ROWS = types.Array(types.float32, 2, "A")  # whole matrices and parts of larger ones
LINE = types.Array(types.float32, 1, "C")
TABLE, INDEX, VALID = (types.Array(t, 2, "C") for t in (types.float32, types.int64, types.boolean))


@cache
def attend_tokens():
    """The compiled :func:`_attend_tokens`."""
    tables = (INDEX, VALID, TABLE, TABLE, TABLE)
    return kernel_for(_attend_tokens, ROWS, ROWS, ROWS, *tables, types.int64, types.int64, types.int64)


@cache
def compare_tokens():
    """The compiled :func:`_compare_tokens`."""
    return kernel_for(_compare_tokens, ROWS, LINE, INDEX, TABLE, types.int64, types.int64)


def _attend_tokens(q, k, v, index, valid, factor, bias, out, heads, first, last):
    """Write rows ``first`` to ``last`` of ``out``; see :func:`ghgs_lit.recalibration.cpu.attend`."""
    width = q.shape[1] // heads
    scale = np.float32(math.log2(math.e) / math.sqrt(width))
    log2_e = np.float32(math.log2(math.e))
    most = index.shape[1]
    chosen = np.empty(most, np.int64)
    factors, biases = np.empty(most, np.float32), np.empty(most, np.float32)
    weights = simd.aligned(-(-most // LANES) * LANES)
    for token in range(first, last):
        count = 0
        for j in range(most):
            if valid[token, j]:
                chosen[count] = index[token, j]
                factors[count], biases[count] = scale * factor[token, j], log2_e * bias[token, j]
                count += 1
        for head in range(heads):
            start = head * width
            for j in range(count):
                logit = factors[j] * _dot(q[token], k[chosen[j]], start, width)
                weights[j] = logit + biases[j]
            share = np.float32(1) / _exponentials(weights, count)
            for at in range(start, start + width, LANES):
                total = simd.full(np.float32(0))
                for j in range(count):
                    total = simd.fma(memory.load_anywhere(v[chosen[j]], at), weights[j], total)
                memory.store_anywhere(out[token], at, total * simd.full(share))


def _compare_tokens(features, inverse_lengths, index, out, first, last):
    """Write rows ``first`` to ``last`` of ``out``: cosines of each token and its neighbours ``index``."""
    width = features.shape[1]
    unit = simd.aligned(width)
    for token in range(first, last):
        row, inverse = features[token], simd.full(inverse_lengths[token])
        for at in range(0, width, LANES):
            memory.store(unit, at, memory.load_anywhere(row, at) * inverse)
        for j in range(index.shape[1]):
            other = index[token, j]
            out[token, j] = _dot(unit, features[other], 0, width) * inverse_lengths[other]


@helper
def _dot(x, y, start, width):
    total = simd.full(np.float32(0))
    for at in range(start, start + width, LANES):
        total = simd.fma(memory.load_anywhere(x, at), memory.load_anywhere(y, at), total)
    return simd.lane_sum(total)


@helper
def _exponentials(values, count):
    """Replace ``count`` values by ``2^(value - largest)`` and return their sum; NaN stays."""
    for j in range(count, len(values)):
        values[j] = LOWEST
    highest = simd.full(LOWEST)
    for j in range(0, count, LANES):
        highest = simd.maximum(memory.load(values, j), highest)
    top = simd.full(simd.lane_max(highest))
    total, limit = simd.full(np.float32(0)), simd.full(EXP2_LIMIT)
    for j in range(0, count, LANES):
        power = simd.exp2_minus(simd.minimum(limit, top - memory.load(values, j)))
        total = total + power
        memory.store(values, j, power)
    return simd.lane_sum(total)
