"""CPU kernel of attention, ``KEYS`` keys at a time with a running maximum (FlashAttention, Dao et al.
2022). Powers of 2 replace the exponential: ``exp(x) = 2^(x log2 e)``."""

import itertools
import math
from functools import partial
from itertools import pairwise

import numpy as np
import torch
from numba.core import types
from torch import Tensor

from ghgs_lit.ops import memory, pool, simd
from ghgs_lit.ops.compile import NUMBER, helper, kernel_for
from ghgs_lit.ops.layers import PANEL, ROWS, make_product, product
from ghgs_lit.ops.simd import EXP2_LIMIT

#: Number of keys whose scores are in memory at once.
KEYS = 256
#: Number of queries that are multiplied with these keys before the next keys are read.
QUERIES = 96

LANES = simd.LANES
LOWEST = np.float32(-np.inf)
#: ``out += x y`` for rows ``x`` of ``KEYS`` contiguous numbers.
add_values = make_product((KEYS, 1), adds=True)


@kernel_for(*[types.Array(types.float32, 2, "A")] * 4, NUMBER, NUMBER)
def attend_head(q, k, v, out, first, last):
    """Write ``softmax(q k^T / sqrt(d)) v`` of some queries of a head.

    Matrices may have any strides; their width d is a multiple of 32.

    Args:
        q: queries [t, d].
        k: keys [s, d].
        v: values [s, d].
        out: written [t, d].
        first: first query.
        last: end of the queries, excluded.
    """
    tokens, width = k.shape
    scale = np.float32(math.log2(math.e) / math.sqrt(width))
    keys = _pack_keys(k)
    values = _pack_values(v)
    queries = simd.aligned(QUERIES * width)
    scores = simd.aligned(ROWS * KEYS)
    weights = simd.aligned(ROWS * KEYS)
    totals = simd.aligned(QUERIES * width)
    sums = simd.aligned(QUERIES * LANES)
    highest = np.empty(QUERIES, np.float32)
    for start in range(first, last, QUERIES):
        count = min(QUERIES, last - start)
        _pack_queries(q, start, count, queries)
        totals[:] = 0
        sums[:] = 0
        highest[:] = LOWEST
        for key in range(0, tokens, KEYS):
            seen = min(KEYS, tokens - key)
            for row in range(0, count, ROWS):
                _score(queries, row, keys, key, seen, width, scores)
                for r in range(row, row + ROWS):
                    old = highest[r]
                    top = _highest(scores, r - row, seen) * scale
                    if top > old:
                        _scale_down(old - top, sums, totals, r, width)
                        highest[r] = top
                    _weigh(scores, r - row, seen, scale, highest[r], weights, sums, r)
                _add_values(weights, values, key, seen, totals, row, width)
        for r in range(count):
            _finish(out[start + r], sums, totals, r, width)


@helper
def _round_up(count):
    return -(-count // PANEL) * PANEL


@helper
def _pack_keys(k):
    """Pack keys into panels [channels, PANEL]; the last panel is padded with zeros."""
    tokens, steps = k.shape
    packed = simd.aligned(_round_up(tokens) * steps)
    for panel in range(0, tokens, PANEL):
        count = min(PANEL, tokens - panel)
        for t in range(steps):
            at = panel * steps + t * PANEL
            for i in range(count):
                packed[at + i] = k[panel + i, t]
            for i in range(count, PANEL):
                packed[at + i] = 0
    return packed


@helper
def _pack_values(v):
    """Pack values into panels [tokens, PANEL] of ``PANEL`` channels; tokens are padded with zeros."""
    tokens, width = v.shape
    lines = _round_up(tokens)
    packed = simd.aligned(lines * width)
    for panel in range(0, width, PANEL):
        for line in range(lines):
            at = panel * lines + line * PANEL
            for i in range(PANEL):
                packed[at + i] = v[line, panel + i] if line < tokens else 0
    return packed


@helper
def _pack_queries(q, start, count, packed):
    """Pack ``count`` queries, at most ``QUERIES``, into tiles [channels, ROWS], of which the last is padded
    with the last query."""
    steps = q.shape[1]
    for row in range(0, count, ROWS):
        for r in range(ROWS):
            source = start + min(row + r, count - 1)
            for t in range(steps):
                packed[row * steps + t * ROWS + r] = q[source, t]


@helper
def _score(queries, row, keys, key, seen, steps, scores):
    """Write the scores, [ROWS * KEYS], of ``ROWS`` queries and ``seen`` keys, at most ``KEYS``, padded with
    -inf."""
    for panel in range(0, seen, PANEL):
        product(queries, row * steps, keys, (key + panel) * steps, steps, scores, panel, KEYS)
    for r in range(ROWS):
        for i in range(seen, _round_up(seen)):
            scores[r * KEYS + i] = LOWEST


@helper
def _highest(scores, r, seen):
    """Highest score of a row; it ignores NaN, which reaches the result through the weights."""
    highest = simd.full(LOWEST)
    for i in range(0, seen, LANES):
        highest = simd.maximum(memory.load(scores, r * KEYS + i), highest)
    return simd.lane_max(highest)


@helper
def _scale_down(exponent, sums, totals, r, width):
    """Rescale the sums of a query's weights and weighted values by ``2^exponent`` when its maximum has
    grown, with ``exponent <= 0``."""
    factor = simd.exp2_minus(simd.full(min(-exponent, EXP2_LIMIT)))
    memory.store(sums, r * LANES, memory.load(sums, r * LANES) * factor)
    for i in range(r * width, (r + 1) * width, LANES):
        memory.store(totals, i, memory.load(totals, i) * factor)


@helper
def _weigh(scores, r, seen, scale, top, weights, sums, query):
    """Write the weights ``2^(scale s - top)`` of a row of scores, and add them to the query's lanes of
    ``sums``.

    Args:
        scores: from :func:`_score`.
        r: row of ``scores``.
        seen: number of keys.
        scale: ``log2(e) / sqrt(d)``.
        top: highest score so far, times ``scale``.
        weights: written [ROWS * KEYS].
        sums: accumulated, sums of weights per lane [QUERIES * LANES].
        query: index of the query in ``sums``.
    """
    total = memory.load(sums, query * LANES)
    minus = simd.full(-scale)
    limit = simd.full(EXP2_LIMIT)
    for i in range(0, _round_up(seen), LANES):
        depth = simd.fma(memory.load(scores, r * KEYS + i), minus, top)
        # ``minimum`` returns the second argument where either is NaN, so NaN stays NaN.
        weight = simd.exp2_minus(simd.minimum(limit, depth))
        total = total + weight
        memory.store(weights, r * KEYS + i, weight)
    memory.store(sums, query * LANES, total)


@helper
def _add_values(weights, values, key, seen, totals, row, width):
    """Add the values of ``seen`` keys, weighted by ``weights`` [ROWS * KEYS], to the ``totals``
    [QUERIES * d] of ``ROWS`` queries."""
    lines = len(values) // width
    for panel in range(0, width, PANEL):
        at = row * width + panel
        add_values(weights, 0, values, panel * lines + key * PANEL, _round_up(seen), totals, at, width)


@helper
def _finish(out, sums, totals, r, width):
    """Write the weighted values of a query, divided by the sum of its weights, to ``out`` [d]."""
    share = np.float32(1) / simd.lane_sum(memory.load(sums, r * LANES))
    for i in range(0, width, LANES):
        memory.store_anywhere(out, i, memory.load(totals, r * width + i) * simd.full(share))


def attend(q: Tensor, k: Tensor, v: Tensor, keys: None) -> Tensor:
    """Kernel of the operator of :mod:`ghgs_lit.ops.attention`."""
    return attend_heads(q, k, v).flatten(2)


def attend_heads(q: Tensor, k: Tensor, v: Tensor) -> Tensor:
    """``softmax(q k^T / sqrt(d)) v`` of every head, computed in float32.

    Args:
        q: queries [n, a, t, d] of n sequences and a heads.
        k: keys [n, a, s, d].
        v: values [n, a, s, d].

    Returns:
        [n, t, a, d] in the dtype of ``v``, bitwise the same for any number of threads.
    """
    out = torch.empty(q.transpose(1, 2).shape)
    arrays = [_rows(x.float()).numpy() for x in (q, k, v, out.transpose(1, 2))]
    n, a, t, d = q.shape
    heads = list(itertools.product(range(n), range(a)))
    # Each task packs keys and values again, so heads are split only if they are few.
    parts = max(1, min(-(-2 * torch.get_num_threads() // len(heads)), t // QUERIES))
    edges = [t * p // (parts * QUERIES) * QUERIES for p in range(parts)] + [t]
    compiled = attend_head()
    tasks = []
    for head in heads:
        matrices = [x[head] for x in arrays]
        tasks += [partial(compiled, *matrices, first, last) for first, last in pairwise(edges)]
    pool.run(tasks, work=n * a * t * d)
    return out.to(v.dtype)


def _rows(x: Tensor) -> Tensor:
    return x if x.stride(-1) == 1 else x.contiguous()
