"""The list of splats of each tile, in the order in which they are drawn.

Each part of the Gaussians writes its splats to the lists of the tiles in the order of their index; then
each tile sorts its own list by depth with a stable sort. So the order does not depend on the number of parts
or threads, and no sort is larger than a tile.
"""

import numpy as np

from ghgs_lit.kernels.compile import helper, kernel
from ghgs_lit.rendering.cpu import layout

_DIGIT = 8
_BUCKETS = 1 << _DIGIT
# For this many keys or fewer, insertion sort is faster than radix sort.
_FEW = 24


@kernel
def scatter(first, last, shifts, depths, boxes, tiles_x, slot, entry_starts, next_free, entries):
    """List the splats of Gaussians ``first`` to ``last`` in every tile that they touch.

    ``next_free`` [T, tiles] is the place of this part's next entry in each tile; the slots of the part begin
    at ``slot``, and ``entry_starts`` receives the first slot of every visible splat.
    """
    keys = depths.view(np.int32)
    for t in range(len(shifts)):
        for m in range(first + shifts[t], last + shifts[t]):
            entry_starts[m] = slot
            for y in range(boxes[m, layout.Y0], boxes[m, layout.Y1]):
                for x in range(boxes[m, layout.X0], boxes[m, layout.X1]):
                    entry = next_free[t, y * tiles_x + x]
                    next_free[t, y * tiles_x + x] = entry + 1
                    entries[entry, layout.KEY] = keys[m, 0]
                    entries[entry, layout.SPLAT] = m
                    entries[entry, layout.SLOT] = slot
                    slot += 1


@helper
def _insertion_sort(keys, count):
    for i in range(1, count):
        key, k = keys[i], i
        while k > 0 and keys[k - 1] > key:
            keys[k] = keys[k - 1]
            k -= 1
        keys[k] = key


@helper
def _radix_pass(keys, new_keys, count, shift, places):
    """Sort by one digit of the keys, stably, to ``new_keys``."""
    places[:] = 0
    for i in range(count):
        places[(keys[i] >> shift) & (_BUCKETS - 1)] += 1
    total = 0
    for bucket in range(_BUCKETS):
        size = places[bucket]
        places[bucket] = total
        total += size
    for i in range(count):
        bucket = (keys[i] >> shift) & (_BUCKETS - 1)
        new_keys[places[bucket]] = keys[i]
        places[bucket] += 1


@helper
def depth_order(entries, start, end, keys, spare, places):
    """The entries of one tile sorted by depth, ties in their present order.

    Returns keys whose lower halves are rows of ``entries``. The bits of positive floats sort like integers;
    relative to the smallest of a tile, only a few low digits differ.
    """
    count, least, most = end - start, entries[start, layout.KEY], entries[start, layout.KEY]
    for i in range(start, end):
        least, most = min(least, entries[i, layout.KEY]), max(most, entries[i, layout.KEY])
    for i in range(count):
        keys[i] = (np.int64(entries[start + i, layout.KEY] - least) << 32) | (start + i)
    if count <= _FEW:
        _insertion_sort(keys, count)
        return keys[:count]
    span, shift = np.int64(most) - least, 0
    while span >> shift > 0:
        _radix_pass(keys, spare, count, 32 + shift, places)
        keys, spare = spare, keys
        shift += _DIGIT
    return keys[:count]
