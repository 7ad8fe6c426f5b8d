"""Gradients of splats from gradients of pixels, one tile at a time.

The backward pass repeats the forward pass front to back. Let ``v_i`` be the product of the pixel's
gradient with splat ``i``'s colour, depth and 1, and ``S`` the sum of ``w_j v_j`` over the splats
behind it. Then ``dL/d alpha_i = T_i v_i - S / (1 - alpha_i)``. ``S``, one number per pixel, starts
as the sum over all splats."""

import numpy as np

from ghgs_lit.ops import memory, simd
from ghgs_lit.ops.compile import helper, kernel
from ghgs_lit.ops.rasterization import layout, tables, tiles
from ghgs_lit.ops.rasterization.tiles import BLOCKS, LANES, LEAST_ALPHA, ONE, PLANES, ZERO

# Distance in entries from a splat that is read to the one that is prefetched.
_AHEAD = 8


@helper
def _read(image, first, width, rows, columns, block):
    """Load a 4 x 4 block (0 to 15) of a tile as 16 floats, with 0 outside the tile's ``rows`` x
    ``columns`` pixels in the flat image."""
    y = block // 4 * 4
    x = block % 4 * 4
    if y + 4 <= rows and x + 4 <= columns:
        return tables.load_block(image, first + y * width + x, width)
    edge = np.zeros(LANES, np.float32)
    for i in range(y, min(y + 4, rows)):
        for j in range(x, min(x + 4, columns)):
            edge[(i - y) * 4 + j - x] = image[first + i * width + j]
    return tables.load_block(edge, 0, 4)


@helper
def _read_gradients(
    view, first, height, width, rows, columns, image, alpha, depth, d_image, d_alpha, d_depth, upstream,
    suffix,
):  # fmt: skip
    """Fill ``upstream`` with the gradients of a tile's planes, and ``suffix`` with ``S`` of all splats.

    With depth = D / A, ``dL/dD = g / A`` and ``dL/dA = -g depth / A``, so the terms of D and A
    in ``S`` cancel.

    Args:
        view: index of the view.
        first: index of the tile's first pixel in a plane of the image.
        height: image height in pixels.
        width: image width in pixels.
        rows: rows of the tile inside the image.
        columns: columns of the tile inside the image.
        image: flat [V 3 h w].
        alpha: flat [V h w].
        depth: expected depth, flat [V h w].
        d_image: gradient of the image, flat [V 3 h w].
        d_alpha: gradient of alpha, flat [V h w]; of size 0 if there is none.
        d_depth: gradient of the depth, flat [V h w]; of size 0 if there is none.
        upstream: written, gradients of the planes (colour, ``w z``, ``w``), [PLANES x PIXELS], block by
            block.
        suffix: written, ``S``, [PIXELS], block by block.
    """
    start = view * height * width + first
    for block in range(BLOCKS):
        at = block * LANES
        total = simd.full(ZERO)
        d_sum = simd.full(ZERO)
        d_total = simd.full(ZERO)
        for c in range(layout.CHANNELS):
            plane = (view * layout.CHANNELS + c) * height * width + first
            slope = _read(d_image, plane, width, rows, columns, block)
            total = simd.fma(slope, _read(image, plane, width, rows, columns, block), total)
            memory.store(upstream, c * layout.PIXELS + at, slope)
        seen = _read(alpha, start, width, rows, columns, block)
        if len(d_alpha) > 0:
            d_total = _read(d_alpha, start, width, rows, columns, block)
            total = simd.fma(d_total, seen, total)
        if len(d_depth) > 0:
            slope = _read(d_depth, start, width, rows, columns, block)
            d_sum = slope / simd.maximum(seen, LEAST_ALPHA)
            product = slope * _read(depth, start, width, rows, columns, block)
            free = seen > LEAST_ALPHA
            d_total = simd.select(free, d_total - product / seen, d_total)
            total = simd.select(free, total, total + product)
        memory.store(upstream, layout.CHANNELS * layout.PIXELS + at, d_sum)
        memory.store(upstream, (layout.CHANNELS + 1) * layout.PIXELS + at, d_total)
        memory.store(suffix, at, total)


@helper
def _differentiate_splat(records, s, x0, y0, hit, pixels, transmittance, upstream, suffix, sums, alpha_max):
    """Compute the gradients of one entry (a splat in a tile), and advance ``transmittance`` and
    ``suffix`` past the splat.

    Args:
        records: [splats, RECORD].
        s: index of the splat.
        x0: first column of the tile, in pixels.
        y0: first row of the tile, in pixels.
        hit: bit mask of the blocks that the splat reaches.
        pixels: coordinates of the tile's pixels, from :func:`tiles.grid`.
        transmittance: in front of the splat, [PIXELS]; on return, behind it.
        upstream: gradients of the planes, from :func:`_read_gradients`.
        suffix: ``S`` with this splat, [PIXELS]; on return, without it.
        sums: written, a row of 16 lanes for each gradient of an entry (see ``layout``), to be
            summed over lanes.
        alpha_max: upper limit of alpha.
    """
    zero = simd.full(ZERO)
    numbers = tiles.read_splat(records[s], np.float32(x0), np.float32(y0))
    depth = records[s, layout.DEPTH]
    h = zero
    h_p = zero
    h_q = zero
    h_pp = zero
    h_pq = zero
    h_qq = zero
    d_depth = zero
    for c in range(layout.CHANNELS):
        memory.store(sums, (layout.COLOR + c) * LANES, zero)
    while hit != 0:
        block = simd.trailing_zeros(hit)
        hit &= hit - 1
        at = block * LANES
        dx = numbers[0] + memory.load(pixels, at)
        dy = numbers[1] + memory.load(pixels, layout.PIXELS + at)
        p, q = tiles.whiten(numbers, dx, dy)
        before = memory.load(transmittance, at)
        raw, alpha, _, seen, _, left = tiles.blend(numbers, p, q, before, alpha_max)
        memory.store(transmittance, at, left)
        weight = simd.select(seen, before * alpha, ZERO)
        d_sum = memory.load(upstream, layout.CHANNELS * layout.PIXELS + at)
        value = simd.fma(d_sum, depth, memory.load(upstream, (layout.CHANNELS + 1) * layout.PIXELS + at))
        d_depth = simd.fma(weight, d_sum, d_depth)
        for c in range(layout.CHANNELS):
            slope = memory.load(upstream, c * layout.PIXELS + at)
            value = simd.fma(slope, records[s, layout.COLORS + c], value)
            row = (layout.COLOR + c) * LANES
            memory.store(sums, row, simd.fma(weight, slope, memory.load(sums, row)))
        rest = memory.load(suffix, at) - simd.select(seen, weight * value, ZERO)
        memory.store(suffix, at, rest)
        # dL / d ln(alpha), where alpha is not clamped.
        slope = alpha * (before * value - rest / (ONE - alpha))
        slope = simd.select(seen & (raw < alpha_max), slope, ZERO)
        s_p = slope * p
        s_q = slope * q
        h = h + slope
        h_p = h_p + s_p
        h_q = h_q + s_q
        h_pp = simd.fma(s_p, p, h_pp)
        h_pq = simd.fma(s_p, q, h_pq)
        h_qq = simd.fma(s_q, q, h_qq)
    memory.store(sums, layout.H * LANES, h)
    memory.store(sums, layout.H_P * LANES, h_p)
    memory.store(sums, layout.H_Q * LANES, h_q)
    memory.store(sums, layout.H_PP * LANES, h_pp)
    memory.store(sums, layout.H_PQ * LANES, h_pq)
    memory.store(sums, layout.H_QQ * LANES, h_qq)
    memory.store(sums, layout.D_DEPTH * LANES, d_depth)


@kernel
def backward(
    some_tiles, tiles_x, tiles_y, height, width, views, tile_starts, entries, records, alpha_max, drawn,
    image, alpha, depth, d_image, d_alpha, d_depth, gradients,
):  # fmt: skip
    """Write the gradients of the rendered entries of tiles.

    Args:
        some_tiles: indices of tiles, counted over all views, int64.
        tiles_x: number of tiles across a view.
        tiles_y: number of tiles down a view.
        height: image height in pixels.
        width: image width in pixels.
        views: cameras, float64 [V, VIEW].
        tile_starts: first entry of each tile, int64 [V tiles + 1].
        entries: int32 [entries, ENTRY], in the order in which ``forward`` left them.
        records: [splats, RECORD].
        alpha_max: upper limit of alpha.
        drawn: number of rendered entries of each tile, int64 [V tiles].
        image: rendered colours, flat [V 3 h w].
        alpha: rendered alpha, flat [V h w].
        depth: rendered depth, flat [V h w].
        d_image: gradient of the image, flat [V 3 h w].
        d_alpha: gradient of alpha, flat [V h w]; of size 0 if there is none.
        d_depth: gradient of the depth, flat [V h w]; of size 0 if there is none.
        gradients: written by slot, flat [slots x GRADIENT], aligned to a cache line.
    """
    transmittance = simd.aligned(layout.PIXELS)
    suffix = simd.aligned(layout.PIXELS)
    upstream = simd.aligned(PLANES * layout.PIXELS)
    sums = simd.aligned(layout.GRADIENT * LANES)
    pixels = tiles.grid()
    for tile in some_tiles:
        view, x0, y0, rows, columns, first = tiles.place(tile, tiles_x, tiles_y, height, width)
        _read_gradients(
            view, first, height, width, rows, columns, image, alpha, depth, d_image, d_alpha, d_depth,
            upstream, suffix,
        )  # fmt: skip
        tiles.open_pixels(views[view], x0, y0, pixels, transmittance)
        start = tile_starts[tile]
        end = tile_starts[tile] + drawn[tile]
        for entry in range(start, end):
            later = min(entry + _AHEAD, end - 1)
            memory.prefetch(records, entries[later, layout.SPLAT] * layout.RECORD)
            memory.prefetch(gradients, entries[later, layout.SLOT] * layout.GRADIENT)
            s = entries[entry, layout.SPLAT]
            hit = np.int64(entries[entry, layout.BLOCKS])
            _differentiate_splat(
                records, s, x0, y0, hit, pixels, transmittance, upstream, suffix, sums, alpha_max
            )
            slot = entries[entry, layout.SLOT]
            memory.store(gradients, slot * layout.GRADIENT, tables.row_sums(sums))
