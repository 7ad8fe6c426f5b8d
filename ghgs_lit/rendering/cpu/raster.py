"""Splats to pixels and back, one tile of 16 x 16 at a time, one block of 4 x 4 pixels per vector.

Small splats are the rule (a splat for each input pixel), and a 4 x 4 block holds one better than a row
of 16. A splat visits the blocks that its bounding box meets and that still have a transparent pixel.
The backward pass replays the forward pass front to back: with ``v_i`` the gradient's product with splat
``i``'s colour, depth and one, and ``S`` the sum of ``w_j v_j`` over the splats behind, ``dL/d alpha_i =
T_i v_i - S / (1 - alpha_i)``. ``S`` starts as the pixel's own total and shrinks: one number a pixel.
"""

import numpy as np

from ghgs_lit.rendering.cpu import layout, simd
from ghgs_lit.rendering.cpu.compile import helper, kernel

_LANES = simd.LANES


@helper
def _scratch(vectors):
    """``vectors`` x 16 floats whose memory starts on a cache line."""
    buffer = np.empty((vectors + 1) * _LANES, np.float32)
    skip = (-(buffer.ctypes.data // 4)) % _LANES
    return buffer[skip : skip + vectors * _LANES]


@helper
def _inside(transmittance, x0, y0, width, height):
    """Set T to 1 inside the image and 0 outside; returns the blocks that have a pixel in the image."""
    live = 0
    for pixel in range(layout.PIXELS):
        block, lane = pixel // _LANES, pixel % _LANES
        x = x0 + (block % 4) * 4 + lane % 4
        y = y0 + (block // 4) * 4 + lane // 4
        is_inside = x < width and y < height
        transmittance[pixel] = 1.0 if is_inside else 0.0
        if is_inside:
            live |= 1 << block
    return live


@helper
def _touched(record, x0, y0):
    """The blocks of a tile that a splat's bounding box meets, as bits; a hair more than those it hits."""
    x = (record[layout.COLUMN] - x0) - record[layout.REST_X]
    y = (record[layout.ROW] - y0) - record[layout.REST_Y]
    reach_x, reach_y = (
        record[layout.HALF_WIDTH] + np.float32(0.01),
        record[layout.HALF_HEIGHT] + np.float32(0.01),
    )
    left = int(max(np.float32(0), np.ceil(x - reach_x))) // 4
    right = int(min(np.float32(layout.TILE - 1), np.floor(x + reach_x))) // 4
    top = int(max(np.float32(0), np.ceil(y - reach_y))) // 4
    bottom = int(min(np.float32(layout.TILE - 1), np.floor(y + reach_y))) // 4
    row = ((2 << right) - 1) & ~((1 << left) - 1)
    rows = ((1 << (4 * bottom + 4)) - 1) & ~((1 << (4 * top)) - 1)
    return (row * 0x1111) & rows


@helper
def _image_rows(image, y0, x0, plane):
    """Copy one plane of a tile from blocks to rows of the image, cut at its border."""
    height, width = image.shape
    for y in range(min(layout.TILE, height - y0)):
        for x in range(min(layout.TILE, width - x0)):
            image[y0 + y, x0 + x] = plane[(y // 4 * 4 + x // 4) * _LANES + y % 4 * 4 + x % 4]


@helper
def _tile_rows(image, y0, x0, plane):
    """Copy a tile of the image into blocks; zero beyond its border."""
    height, width = image.shape
    plane[:] = 0.0
    for y in range(min(layout.TILE, height - y0)):
        for x in range(min(layout.TILE, width - x0)):
            plane[(y // 4 * 4 + x // 4) * _LANES + y % 4 * 4 + x % 4] = image[y0 + y, x0 + x]


@helper
def _offsets(record, x0, y0, block):
    """Distances from a splat's centre to the pixels of a block."""
    x = np.float32(x0 + block % 4 * 4) - record[layout.COLUMN] + record[layout.REST_X]
    y = np.float32(y0 + block // 4 * 4) - record[layout.ROW] + record[layout.REST_Y]
    return simd.lane_columns() + simd.full(x), simd.lane_rows() + simd.full(y)


@helper
def _whiten(record, dx, dy):
    p = simd.full(record[layout.K_XX]) * dx
    q = simd.fma(simd.full(record[layout.K_YX]), dx, simd.full(record[layout.K_YY]) * dy)
    return p, q


@helper
def _blend(record, squared, transmittance, alpha_max, stop):
    """One splat over one block of pixels.

    Returns the unclamped and the clamped alpha, the lanes where the splat is meant to be seen, those
    where it is, and T behind it. Where T would fall to ``stop`` the splat is left out and T becomes 0,
    which stops all that follow: ``0 > stop`` is false.
    """
    cutoff = simd.full(record[layout.CUTOFF])
    reached = (squared <= cutoff) & (transmittance > simd.full(np.float32(0)))
    raw = simd.full(record[layout.OPACITY]) * simd.exp2(
        simd.full(np.float32(0)) - simd.minimum(squared, cutoff)
    )
    alpha = simd.minimum(raw, simd.full(alpha_max))
    behind = transmittance - transmittance * alpha
    seen = reached & (behind > simd.full(stop))
    left = simd.select(reached, simd.select(seen, behind, simd.full(np.float32(0))), transmittance)
    return raw, alpha, reached, seen, left


@helper
def _add(planes, position, seen, weight, value):
    """Add ``weight * value`` in the lanes that see the splat; a value that is not finite stays there."""
    old = simd.load(planes, position)
    simd.store(planes, position, simd.select(seen, simd.fma(weight, simd.full(value), old), old))


@helper
def _forward_splat(record, color, x0, y0, live, planes, transmittance, alpha_max, stop):
    """Add one splat to a tile; returns the blocks it reached and the blocks that are still open."""
    channels = len(color)
    todo, hit = _touched(record, x0, y0) & live, 0
    while todo != 0:
        block = simd.trailing_zeros(todo)
        todo &= todo - 1
        at = block * _LANES
        dx, dy = _offsets(record, x0, y0, block)
        p, q = _whiten(record, dx, dy)
        before = simd.load(transmittance, at)
        _, alpha, reached, seen, left = _blend(record, simd.fma(p, p, q * q), before, alpha_max, stop)
        if simd.bits(reached) == 0:
            continue
        hit |= 1 << block
        simd.store(transmittance, at, left)
        if simd.bits(left > simd.full(np.float32(0))) == 0:
            live &= ~(1 << block)
        weight = before * alpha
        for c in range(channels):
            _add(planes, c * layout.PIXELS + at, seen, weight, color[c])
        _add(planes, channels * layout.PIXELS + at, seen, weight, record[layout.DEPTH])
        _add(planes, (channels + 1) * layout.PIXELS + at, seen, weight, np.float32(1))
    return hit, live


@kernel
def forward(
    tiles, tiles_x, tiles_y, tile_starts, splats, shifts, records, colors, alpha_max, stop, hits, image
):
    """Blend the given ``tiles`` into ``image`` [V, C + 2, h, w]: colours, sum of w z, sum of w.

    ``hits`` [entries] receives the blocks that each entry reached, for the backward pass.
    """
    planes_count, height, width = image.shape[1:]
    transmittance, planes = (
        _scratch(layout.PIXELS // _LANES),
        _scratch(planes_count * layout.PIXELS // _LANES),
    )
    for tile in tiles:
        view, inner = tile // (tiles_x * tiles_y), tile % (tiles_x * tiles_y)
        y0, x0 = inner // tiles_x * layout.TILE, inner % tiles_x * layout.TILE
        planes[:] = 0.0
        live = _inside(transmittance, x0, y0, width, height)
        for entry in range(tile_starts[tile], tile_starts[tile + 1]):
            if live == 0:
                hits[entry] = 0
                continue
            s = splats[entry]
            hit, live = _forward_splat(
                records[s], colors[s + shifts[view]], x0, y0, live, planes, transmittance, alpha_max, stop
            )
            hits[entry] = hit
        for c in range(planes_count):
            _image_rows(image[view, c], y0, x0, planes[c * layout.PIXELS : (c + 1) * layout.PIXELS])


@helper
def _suffix(planes, upstream, count, suffix):
    """``S`` before the first splat: each pixel's gradient times its own values."""
    suffix[:] = 0.0
    for c in range(count):
        for pixel in range(layout.PIXELS):
            at = c * layout.PIXELS + pixel
            # A pixel without gradient owes nothing, also where its value is not finite.
            if upstream[at] != 0:
                suffix[pixel] += upstream[at] * planes[at]


@helper
def _backward_splat(record, color, x0, y0, hit, transmittance, upstream, suffix, sums, alpha_max, stop):
    """Sum one splat's gradients over a tile into the rows of ``sums``."""
    channels = len(color)
    zero = simd.full(np.float32(0))
    h, h_p, h_q, h_pp, h_pq, h_qq, d_depth = zero, zero, zero, zero, zero, zero, zero
    for c in range(channels):
        simd.store(sums, (layout.COLOR + c) * _LANES, zero)
    while hit != 0:
        block = simd.trailing_zeros(hit)
        hit &= hit - 1
        at = block * _LANES
        dx, dy = _offsets(record, x0, y0, block)
        p, q = _whiten(record, dx, dy)
        before = simd.load(transmittance, at)
        raw, alpha, _, seen, left = _blend(record, simd.fma(p, p, q * q), before, alpha_max, stop)
        simd.store(transmittance, at, left)
        weight = simd.select(seen, before * alpha, zero)
        d_z = simd.load(upstream, channels * layout.PIXELS + at)
        value = simd.fma(
            d_z, simd.full(record[layout.DEPTH]), simd.load(upstream, (channels + 1) * layout.PIXELS + at)
        )
        d_depth = simd.fma(weight, d_z, d_depth)
        for c in range(channels):
            d_c = simd.load(upstream, c * layout.PIXELS + at)
            value = simd.fma(d_c, simd.full(color[c]), value)
            row = (layout.COLOR + c) * _LANES
            simd.store(sums, row, simd.fma(weight, d_c, simd.load(sums, row)))
        rest = simd.load(suffix, at)
        rest = simd.select(seen, rest - weight * value, rest)
        simd.store(suffix, at, rest)
        # h = alpha dL/d alpha, where alpha is not clamped.
        slope = alpha * (before * value - rest / (simd.full(np.float32(1)) - alpha))
        slope = simd.select(seen & (raw < simd.full(alpha_max)), slope, zero)
        s_p, s_q = slope * p, slope * q
        h, h_p, h_q = h + slope, h_p + s_p, h_q + s_q
        h_pp, h_pq, h_qq = simd.fma(s_p, p, h_pp), simd.fma(s_p, q, h_pq), simd.fma(s_q, q, h_qq)
    simd.store(sums, layout.H * _LANES, h)
    simd.store(sums, layout.H_P * _LANES, h_p)
    simd.store(sums, layout.H_Q * _LANES, h_q)
    simd.store(sums, layout.H_PP * _LANES, h_pp)
    simd.store(sums, layout.H_PQ * _LANES, h_pq)
    simd.store(sums, layout.H_QQ * _LANES, h_qq)
    simd.store(sums, layout.D_DEPTH * _LANES, d_depth)


@kernel
def backward(
    tiles,
    tiles_x,
    tiles_y,
    tile_starts,
    splats,
    slots,
    shifts,
    records,
    colors,
    alpha_max,
    stop,
    hits,
    image,
    image_gradient,
    gradients,
):
    """Gradients of every entry of the given ``tiles``, from the gradient of ``image``, into ``gradients``."""
    planes_count, height, width = image.shape[1:]
    transmittance, suffix = _scratch(layout.PIXELS // _LANES), _scratch(layout.PIXELS // _LANES)
    planes = _scratch(planes_count * layout.PIXELS // _LANES)
    upstream = _scratch(planes_count * layout.PIXELS // _LANES)
    rows = gradients.shape[1]
    sums, line = _scratch(rows), _scratch(1)
    sums[:] = 0.0
    for tile in tiles:
        view, inner = tile // (tiles_x * tiles_y), tile % (tiles_x * tiles_y)
        y0, x0 = inner // tiles_x * layout.TILE, inner % tiles_x * layout.TILE
        for c in range(planes_count):
            _tile_rows(image[view, c], y0, x0, planes[c * layout.PIXELS : (c + 1) * layout.PIXELS])
            _tile_rows(image_gradient[view, c], y0, x0, upstream[c * layout.PIXELS : (c + 1) * layout.PIXELS])
        _suffix(planes, upstream, planes_count, suffix)
        _inside(transmittance, x0, y0, width, height)
        for entry in range(tile_starts[tile], tile_starts[tile + 1]):
            slot = slots[entry]
            if hits[entry] == 0:
                gradients[slot] = 0.0
                continue
            s = splats[entry]
            _backward_splat(
                records[s],
                colors[s + shifts[view]],
                x0,
                y0,
                np.int64(hits[entry]),
                transmittance,
                upstream,
                suffix,
                sums,
                alpha_max,
                stop,
            )
            for first in range(0, rows, _LANES):
                simd.store(line, 0, simd.row_sums(sums, first * _LANES))
                gradients[slot, first : first + _LANES] = line
