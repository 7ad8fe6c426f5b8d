"""Rendering of splats, one tile at a time, front to back.

First, each part of the Gaussians appends its splats to the lists of their tiles, by index; then each
tile sorts its list stably by depth. The order therefore does not depend on the number of parts or
threads, and no sort is larger than a tile."""

import numpy as np

from ghgs_lit.ops import memory, simd
from ghgs_lit.ops.compile import helper, kernel
from ghgs_lit.ops.rasterization import layout, tables, tiles
from ghgs_lit.ops.rasterization.tiles import BLOCKS, LANES, LEAST_ALPHA, PLANES, ZERO

_DIGIT = 8
_BUCKETS = 1 << _DIGIT
# Up to this many keys, insertion sort is faster than radix sort.
_FEW = 24


@kernel
def scatter(first, last, shifts, depths, boxes, tiles_x, slot, entry_starts, next_free, entries):
    """List the splats of Gaussians ``first`` to ``last`` in every tile that they touch.

    Args:
        first: first Gaussian of the part.
        last: end of the part, excluded.
        shifts: splat index minus Gaussian index in each view of the element, int64 [T].
        depths: positive, float32 [splats, 1].
        boxes: tiles that a splat touches, int32 [splats, 4].
        tiles_x: number of tiles across a view.
        slot: first slot of the part.
        entry_starts: written, the first slot of each splat, int32 [splats].
        next_free: index of the part's next entry in each tile, int64 [T, tiles]; advanced.
        entries: written, int32 [entries, ENTRY].
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
    """Sort the first ``count`` keys in place."""
    for i in range(1, count):
        key = keys[i]
        k = i
        while k > 0 and keys[k - 1] > key:
            keys[k] = keys[k - 1]
            k -= 1
        keys[k] = key


@helper
def _radix_pass(keys, new_keys, count, shift, places):
    """Sort ``count`` non-negative int64 keys stably by the 8-bit digit at bit ``shift``, with a buffer
    ``places`` of 256 int64."""
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
    """Sort the entries of a tile stably by depth.

    Bit patterns of positive floats sort like integers, and relative to the smallest of a tile only a
    few low digits differ.

    Args:
        entries: int32 [entries, ENTRY].
        start: first entry of the tile.
        end: end of the tile's entries, excluded; greater than ``start``.
        keys: buffer for as many int64 as the tile has entries.
        spare: a second buffer of that size.
        places: buffer for 256 int64.

    Returns:
        Keys, a view of ``keys`` or ``spare``, whose lower halves are rows of ``entries``.
    """
    count = end - start
    least = entries[start, layout.KEY]
    most = entries[start, layout.KEY]
    for i in range(start, end):
        least = min(least, entries[i, layout.KEY])
        most = max(most, entries[i, layout.KEY])
    for i in range(count):
        keys[i] = (np.int64(entries[start + i, layout.KEY] - least) << 32) | (start + i)
    if count <= _FEW:
        _insertion_sort(keys, count)
        return keys[:count]
    span = np.int64(most) - least
    shift = 0
    while span >> shift > 0:
        _radix_pass(keys, spare, count, 32 + shift, places)
        keys, spare = spare, keys
        shift += _DIGIT
    return keys[:count]


# Entries that are blended into all blocks before the next ones are read: one per bit of an integer.
_CHUNK = 64
# Rows of depth and colour in a gathered chunk, after the values of ``tiles.read_splat``.
_DEPTH = 7
_COLOR = 8
_ROWS = _COLOR + layout.CHANNELS


@helper
def _touches(numbers, slope_x, slope_y, block):
    """Bit mask of those of 16 splats whose ellipse meets a block.

    The smallest p^2 + q^2 over a box lies on its column or row nearest to the splat's centre, at
    the minimum along it. The comparison has a small tolerance, since it only saves work.

    Args:
        numbers: vectors from :func:`tiles.read_splat`, one lane per splat.
        slope_x: dx / dy of the minimum along a row of pixels.
        slope_y: dy / dx of the minimum along a column of pixels.
        block: index of the block in the tile, 0 to 15.
    """
    side = np.float32(layout.BLOCK - 1)
    left = numbers[0] + np.float32(block % 4 * 4)
    top = numbers[1] + np.float32(block // 4 * 4)
    right = left + side
    bottom = top + side
    near_x = simd.minimum(simd.maximum(left, ZERO), right)
    near_y = simd.minimum(simd.maximum(top, ZERO), bottom)
    along_x = simd.minimum(simd.maximum(left, near_y * slope_x), right)
    along_y = simd.minimum(simd.maximum(top, near_x * slope_y), bottom)
    p, q = tiles.whiten(numbers, near_x, along_y)
    u, v = tiles.whiten(numbers, along_x, near_y)
    least = simd.minimum(simd.fma(p, p, q * q), simd.fma(u, u, v * v))
    return simd.bits(least <= numbers[6] * np.float32(1.001) + np.float32(0.001))


@helper
def _fetch(order, i, entries, records, splats):
    """Write the indices of the splats of a chunk, padded with the last one, and prefetch the records of
    the next chunk.

    Args:
        order: keys of the tile's entries, from :func:`depth_order`.
        i: first key of the chunk.
        entries: int32 [entries, ENTRY].
        records: [splats, RECORD].
        splats: written, int64 [_CHUNK].
    """
    for k in range(_CHUNK):
        splats[k] = entries[order[min(i + k, len(order) - 1)] & 0xFFFFFFFF, layout.SPLAT]
        if i + k + _CHUNK < len(order):
            later = entries[order[i + k + _CHUNK] & 0xFFFFFFFF, layout.SPLAT]
            memory.prefetch(records, later * layout.RECORD)


@helper
def _list_chunk(splats, count, records, x0, y0, live, rows, todo):
    """Gather splats and find the blocks that each touches.

    Args:
        splats: indices of splats, int64 [_CHUNK].
        count: number of splats without padding, at most ``_CHUNK``.
        records: [splats, RECORD].
        x0: first column of the tile, in pixels.
        y0: first row of the tile, in pixels.
        live: bit mask of the blocks that are not yet opaque.
        rows: written, ``_CHUNK`` numbers for each value of :func:`tiles.read_splat`, the depth and each
            channel.
        todo: written, bit masks of the splats that touch each block, int64 [BLOCKS].
    """
    todo[:] = 0
    for i in range(0, count, LANES):
        record = tables.gather_lines(records, splats, i)
        numbers = tiles.read_splat(record, np.float32(x0), np.float32(y0))
        memory.store(rows, i, numbers[0])
        memory.store(rows, _CHUNK + i, numbers[1])
        memory.store(rows, 2 * _CHUNK + i, numbers[2])
        memory.store(rows, 3 * _CHUNK + i, numbers[3])
        memory.store(rows, 4 * _CHUNK + i, numbers[4])
        memory.store(rows, 5 * _CHUNK + i, numbers[5])
        memory.store(rows, 6 * _CHUNK + i, numbers[6])
        memory.store(rows, _DEPTH * _CHUNK + i, record[layout.DEPTH])
        here = (1 << min(LANES, count - i)) - 1
        blocks = live
        while blocks != 0:
            block = simd.trailing_zeros(blocks)
            blocks &= blocks - 1
            touching = _touches(numbers, record[layout.SLOPE_X], record[layout.SLOPE_Y], block)
            todo[block] |= (touching & here) << i
        for c in range(layout.CHANNELS):
            memory.store(rows, (_COLOR + c) * _CHUNK + i, record[layout.COLORS + c])


@helper
def _add(planes, position, value):
    """Add a vector to the numbers that start at ``position``."""
    memory.store(planes, position, memory.load(planes, position) + value)


@helper
def _draw_block(block, todo, rows, pixels, planes, transmittance, alpha_max, hits):
    """Blend splats into a block, front to back.

    Args:
        block: index of the block in the tile, 0 to 15.
        todo: bit mask of the chunk's splats to blend.
        rows: numbers of the splats, from :func:`_list_chunk`.
        pixels: coordinates of the tile's pixels, from :func:`tiles.grid`.
        planes: accumulated, sums of the tile (colour, ``w z``, ``w``), [PLANES x PIXELS].
        transmittance: updated, transmittance of the tile, [PIXELS].
        alpha_max: upper limit of alpha.
        hits: the block's bit is set for each splat that reaches the block, int32 [_CHUNK].

    Returns:
        Whether any pixel of the block is not yet opaque.
    """
    at = block * LANES
    bit = np.int32(1) << block
    x = memory.load(pixels, at)
    y = memory.load(pixels, layout.PIXELS + at)
    before = memory.load(transmittance, at)
    while todo != 0:
        i = simd.trailing_zeros(todo)
        todo &= todo - 1
        numbers = (
            rows[i], rows[_CHUNK + i], rows[2 * _CHUNK + i], rows[3 * _CHUNK + i], rows[4 * _CHUNK + i],
            rows[5 * _CHUNK + i], rows[6 * _CHUNK + i],
        )  # fmt: skip
        p, q = tiles.whiten(numbers, x + numbers[0], y + numbers[1])
        _, alpha, reached, seen, is_open, behind = tiles.blend(numbers, p, q, before, alpha_max)
        if simd.bits(reached & (before > ZERO)) != 0:
            hits[i] |= bit
        weight = simd.select(seen, before * alpha, ZERO)
        for c in range(layout.CHANNELS):
            # Select after the product: 0 times a colour that is not finite would be NaN.
            color = simd.select(seen, weight * rows[(_COLOR + c) * _CHUNK + i], ZERO)
            _add(planes, c * layout.PIXELS + at, color)
        _add(planes, layout.CHANNELS * layout.PIXELS + at, weight * rows[_DEPTH * _CHUNK + i])
        _add(planes, (layout.CHANNELS + 1) * layout.PIXELS + at, weight)
        before = behind
        if simd.bits(is_open) == 0:
            break
    memory.store(transmittance, at, before)
    return simd.bits(before > ZERO) != 0


@helper
def _write(image, first, width, rows, columns, block, value):
    """Write a 4 x 4 block (0 to 15) of a tile, a vector of 16 floats, to the tile's ``rows`` x
    ``columns`` pixels in the flat image."""
    y = block // 4 * 4
    x = block % 4 * 4
    if y + 4 <= rows and x + 4 <= columns:
        tables.store_block(image, first + y * width + x, width, value)
        return
    edge = np.empty(LANES, np.float32)
    tables.store_block(edge, 0, 4, value)
    for i in range(y, min(y + 4, rows)):
        for j in range(x, min(x + 4, columns)):
            image[first + i * width + j] = edge[(i - y) * 4 + j - x]


@helper
def _write_planes(planes, view, first, height, width, rows, columns, image, alpha, depth):
    """Write a tile's sums to the images.

    Args:
        planes: sums of the tile (colour, ``w z``, ``w``), [PLANES x PIXELS].
        view: index of the view.
        first: index of the tile's first pixel in a plane of the image.
        height: image height in pixels.
        width: image width in pixels.
        rows: rows of the tile inside the image.
        columns: columns of the tile inside the image.
        image: written, flat [V 3 h w].
        alpha: written, the sum of ``w``, flat [V h w].
        depth: written, the expected depth: the sum of ``w z`` over the sum of ``w``, flat [V h w].
    """
    for block in range(BLOCKS):
        at = block * LANES
        for c in range(layout.CHANNELS):
            start = (view * layout.CHANNELS + c) * height * width + first
            _write(image, start, width, rows, columns, block, memory.load(planes, c * layout.PIXELS + at))
        total = memory.load(planes, (layout.CHANNELS + 1) * layout.PIXELS + at)
        start = view * height * width + first
        _write(alpha, start, width, rows, columns, block, total)
        depths = memory.load(planes, layout.CHANNELS * layout.PIXELS + at)
        _write(depth, start, width, rows, columns, block, depths / simd.maximum(total, LEAST_ALPHA))


@kernel
def forward(
    some_tiles, tiles_x, tiles_y, height, width, views, tile_starts, entries, records, alpha_max, drawn,
    reached, image, alpha, depth,
):  # fmt: skip
    """Render tiles, and keep the rendered entries for the backward pass (see ``layout``).

    Args:
        some_tiles: indices of tiles, counted over all views, int64.
        tiles_x: number of tiles across a view.
        tiles_y: number of tiles down a view.
        height: image height in pixels.
        width: image width in pixels.
        views: cameras, float64 [V, VIEW].
        tile_starts: first entry of each tile, int64 [V tiles + 1].
        entries: int32 [entries, ENTRY]; the rendered ones are moved to the front of each tile.
        records: [splats, RECORD].
        alpha_max: upper limit of alpha.
        drawn: written, number of rendered entries of each tile, int64 [V tiles].
        reached: set to 1 at the slots of rendered entries, uint8 [entries].
        image: written, colours on black, flat [V 3 h w].
        alpha: written, flat [V h w].
        depth: written, expected depth, flat [V h w].
    """
    longest = 1
    for tile in some_tiles:
        longest = max(longest, tile_starts[tile + 1] - tile_starts[tile])
    keys = np.empty(longest, np.int64)
    spare = np.empty(longest, np.int64)
    places = np.empty(256, np.int64)
    kept = np.empty((longest, 3), np.int32)
    rows = simd.aligned(_ROWS * _CHUNK)
    splats = np.empty(_CHUNK, np.int64)
    todo = np.empty(BLOCKS, np.int64)
    hits = np.empty(_CHUNK, np.int32)
    transmittance = simd.aligned(layout.PIXELS)
    planes = simd.aligned(PLANES * layout.PIXELS)
    pixels = tiles.grid()
    for tile in some_tiles:
        view, x0, y0, height_here, width_here, first = tiles.place(tile, tiles_x, tiles_y, height, width)
        planes[:] = ZERO
        live = tiles.open_pixels(views[view], x0, y0, pixels, transmittance)
        start = tile_starts[tile]
        kept_count = 0
        order = depth_order(entries, start, tile_starts[tile + 1], keys, spare, places)
        for i in range(0, len(order), _CHUNK):
            chunk = min(_CHUNK, len(order) - i)
            _fetch(order, i, entries, records, splats)
            _list_chunk(splats, chunk, records, x0, y0, live, rows, todo)
            hits[:] = 0
            for block in range(BLOCKS):
                if todo[block] != 0 and not _draw_block(
                    block, todo[block], rows, pixels, planes, transmittance, alpha_max, hits
                ):
                    live &= ~(1 << block)
            for k in range(chunk):
                if hits[k] != 0:
                    kept[kept_count, 0] = hits[k]
                    kept[kept_count, 1] = splats[k]
                    kept[kept_count, 2] = entries[order[i + k] & 0xFFFFFFFF, layout.SLOT]
                    reached[kept[kept_count, 2]] = 1
                    kept_count += 1
            if live == 0:
                break
        for i in range(kept_count):
            for k in range(3):
                entries[start + i, k] = kept[i, k]
        drawn[tile] = kept_count
        _write_planes(planes, view, first, height, width, height_here, width_here, image, alpha, depth)
