"""Depth order and tile lists: a radix sort of float32 depths, then one stable scatter into the tiles."""

import numpy as np

from ghgs_lit.rendering.cpu import simd
from ghgs_lit.rendering.cpu.compile import helper, kernel

_DIGIT = 11
_BUCKETS = 1 << _DIGIT
# Splats between asking for one's rectangle and reading it: in depth order they lie anywhere.
_AHEAD = 16


@helper
def _radix_pass(keys, order, shift, new_keys, new_order, counts):
    """Sort stably by one digit of the keys; returns False, doing nothing, if all digits are equal."""
    counts[:] = 0
    for key in keys:
        counts[(key >> shift) & (_BUCKETS - 1)] += 1
    if counts[(keys[0] >> shift) & (_BUCKETS - 1)] == len(keys):
        return False
    total = 0
    for bucket in range(_BUCKETS):
        count = counts[bucket]
        counts[bucket] = total
        total += count
    for i in range(len(keys)):
        bucket = (keys[i] >> shift) & (_BUCKETS - 1)
        position = counts[bucket]
        counts[bucket] += 1
        new_keys[position], new_order[position] = keys[i], order[i]
    return True


@helper
def _depth_order(depths, rects, start, count, seen):
    """Visible splats of a view by depth, ties by index. Bits of positive floats order as integers do."""
    keys, order = np.empty(seen, np.uint32), np.empty(seen, np.int32)
    new_keys, new_order = np.empty(seen, np.uint32), np.empty(seen, np.int32)
    bits = depths.view(np.uint32)
    k = 0
    for s in range(start, start + count):
        if rects[s, 0] < rects[s, 1]:
            keys[k], order[k] = bits[s], s
            k += 1
    counts = np.empty(_BUCKETS, np.int64)
    for shift in range(0, 32, _DIGIT):
        if seen > 0 and _radix_pass(keys, order, np.uint32(shift), new_keys, new_order, counts):
            keys, new_keys, order, new_order = new_keys, keys, new_order, order
    return order


@kernel
def scatter(depths, rects, start, count, seen, tiles_x, tile_starts, first_tile, entry_starts, splats, slots):
    """Fill the tile lists of one view.

    ``tile_starts[first_tile + t]`` is where tile ``t``'s entries begin in ``splats`` and ``slots``; entry
    ``slots[i]`` is where the gradients of entry ``i`` go, a splat's own slots being neighbours.
    """
    order = _depth_order(depths, rects, start, count, seen)
    tiles = 0
    for s in range(start, start + count):
        tiles = max(tiles, rects[s, 3])
    next_free = tile_starts[first_tile : first_tile + tiles * tiles_x].copy()
    for i in range(len(order)):
        later = order[min(i + _AHEAD, len(order) - 1)]
        simd.prefetch(rects, later * 4)
        simd.prefetch(entry_starts, later)
        s = order[i]
        slot = entry_starts[s]
        for y in range(rects[s, 2], rects[s, 3]):
            for x in range(rects[s, 0], rects[s, 1]):
                tile = y * tiles_x + x
                position = next_free[tile]
                next_free[tile] += 1
                splats[position], slots[position] = s, slot
                slot += 1
