"""Splats to pixels and back, one tile of 16 x 16 at a time, one block of 4 x 4 pixels per vector.

Small splats are the rule (a splat for each input pixel), and a 4 x 4 block holds one better than a row
of 16. A splat visits the blocks that its ellipse meets and that still have a transparent pixel.
The backward pass replays the forward pass front to back: with ``v_i`` the gradient's product with splat
``i``'s colour, depth and one, and ``S`` the sum of ``w_j v_j`` over the splats behind, ``dL/d alpha_i =
T_i v_i - S / (1 - alpha_i)``. ``S`` starts as the pixel's own total and shrinks: one number a pixel.

The planes of a tile are its colour channels, then the sum of ``w z``, then the sum of ``w``.
"""

import numpy as np

from ghgs_lit.rendering.cpu import layout, simd
from ghgs_lit.rendering.cpu.compile import helper, kernel

_LANES = simd.LANES
_BLOCKS = layout.PIXELS // _LANES
# Entries between asking for a splat and drawing it.
_AHEAD = 8
_ZERO, _ONE = np.float32(0), np.float32(1)
# Gradients of the expected depth end where alpha does: its denominator is held at this.
_LEAST_ALPHA = np.float32(1e-10)


@helper
def _grid():
    """Columns, then rows, of a tile's pixels, block by block."""
    grid = simd.aligned(2 * layout.PIXELS)
    for pixel in range(layout.PIXELS):
        block, lane = pixel // _LANES, pixel % _LANES
        grid[pixel] = block % 4 * 4 + lane % 4
        grid[layout.PIXELS + pixel] = block // 4 * 4 + lane // 4
    return grid


@helper
def _open(views, view, x0, y0, grid, transmittance):
    """Set T to 1 in the pixels of a tile that are wanted, else 0; returns their blocks."""
    live, zero, one = 0, simd.full(_ZERO), simd.full(_ONE)
    left, right = views[view, layout.LEFT] - x0, views[view, layout.RIGHT] - x0
    top, bottom = views[view, layout.TOP] - y0, views[view, layout.BOTTOM] - y0
    left, right = simd.full(np.float32(left)), simd.full(np.float32(right))
    top, bottom = simd.full(np.float32(top)), simd.full(np.float32(bottom))
    for block in range(_BLOCKS):
        at = block * _LANES
        x, y = simd.load(grid, at), simd.load(grid, layout.PIXELS + at)
        within = (x >= left) & (x <= right) & (y >= top) & (y <= bottom)
        simd.store(transmittance, at, simd.select(within, one, zero))
        if simd.bits(within) != 0:
            live |= 1 << block
    return live


@helper
def _read(image, first, width, rows, columns, block):
    """One block of a tile whose first pixel is ``image[first]``; zero beyond ``rows`` x ``columns``."""
    y, x = block // 4 * 4, block % 4 * 4
    if y + 4 <= rows and x + 4 <= columns:
        return simd.load_block(image, first + y * width + x, width)
    edge = np.zeros(_LANES, np.float32)
    for i in range(y, min(y + 4, rows)):
        for j in range(x, min(x + 4, columns)):
            edge[(i - y) * 4 + j - x] = image[first + i * width + j]
    return simd.load_block(edge, 0, 4)


@helper
def _write(image, first, width, rows, columns, block, value):
    """Write one block of a tile, cut at ``rows`` x ``columns``."""
    y, x = block // 4 * 4, block % 4 * 4
    if y + 4 <= rows and x + 4 <= columns:
        simd.store_block(image, first + y * width + x, width, value)
        return
    edge = np.empty(_LANES, np.float32)
    simd.store_block(edge, 0, 4, value)
    for i in range(y, min(y + 4, rows)):
        for j in range(x, min(x + 4, columns)):
            image[first + i * width + j] = edge[(i - y) * 4 + j - x]


@helper
def _splat(records, s, x0, y0):
    """A splat's numbers in all lanes: the way from its centre to the tile's first pixel, its record."""
    x = np.float32(x0) - records[s, layout.COLUMN] + records[s, layout.REST_X]
    y = np.float32(y0) - records[s, layout.ROW] + records[s, layout.REST_Y]
    return (
        simd.full(x),
        simd.full(y),
        simd.full(records[s, layout.K_XX]),
        simd.full(records[s, layout.K_YX]),
        simd.full(records[s, layout.K_YY]),
        simd.full(records[s, layout.OPACITY]),
        simd.full(records[s, layout.CUTOFF]),
    )


@helper
def _whiten(splat, dx, dy):
    """Whitened distances ``p``, ``q``."""
    return splat[2] * dx, simd.fma(splat[3], dx, splat[4] * dy)


@helper
def _touched(splat, slope_x, slope_y):
    """The blocks of a tile that a splat's ellipse meets, as bits: one block a lane.

    A convex function that is least at the centre is least over a box either where the box's column
    nearest to the centre crosses the valley along it, or the same for rows. Compared with a hair more
    than the cutoff, since it only saves work.
    """
    zero, side, four = (
        simd.full(_ZERO),
        simd.full(np.float32(layout.BLOCK - 1)),
        simd.full(np.float32(layout.BLOCK)),
    )
    left, top = simd.fma(simd.lane_columns(), four, splat[0]), simd.fma(simd.lane_rows(), four, splat[1])
    right, bottom = left + side, top + side
    near_x, near_y = (
        simd.minimum(simd.maximum(left, zero), right),
        simd.minimum(simd.maximum(top, zero), bottom),
    )
    along_x = simd.minimum(simd.maximum(left, near_y * simd.full(slope_x)), right)
    along_y = simd.minimum(simd.maximum(top, near_x * simd.full(slope_y)), bottom)
    p, q = _whiten(splat, near_x, along_y)
    u, v = _whiten(splat, along_x, near_y)
    least = simd.minimum(simd.fma(p, p, q * q), simd.fma(u, u, v * v))
    return simd.bits(least <= simd.fma(splat[6], simd.full(np.float32(1.001)), simd.full(np.float32(0.001))))


@helper
def _blend(splat, p, q, before, alpha_max, stop):
    """One splat over one block of pixels.

    Returns the unclamped and the clamped alpha, the lanes that the splat reaches, those where it is
    seen, those that stay open, and T behind it. Where T would fall to ``stop`` the splat is left out
    and T becomes 0, which stops all that follow. Lanes are masked by zeros and stored whole: what was
    written under a mask cannot be forwarded to the next splat's load.
    """
    zero = simd.full(_ZERO)
    squared = simd.fma(p, p, q * q)
    reached = squared <= splat[6]
    # Lanes out of reach are held at the cutoff: denormals there would be slow.
    raw = splat[5] * simd.exp2_minus(simd.minimum(squared, splat[6]))
    alpha = simd.select(reached, simd.minimum(raw, alpha_max), zero)
    behind = before - before * alpha
    is_open = behind > stop
    return raw, alpha, reached, reached & is_open, is_open, simd.select(is_open, behind, zero)


@helper
def _add(planes, position, value):
    simd.store(planes, position, simd.load(planes, position) + value)


@helper
def _forward_splat(records, s, colors, n, count, x0, y0, live, grid, planes, transmittance, alpha_max, stop):
    """Add one splat to a tile; returns the blocks it reached and the blocks that are still open."""
    splat, hit = _splat(records, s, x0, y0), 0
    todo = _touched(splat, records[s, layout.SLOPE_X], records[s, layout.SLOPE_Y]) & live
    zero, depth = simd.full(_ZERO), simd.full(records[s, layout.DEPTH])
    while todo != 0:
        block = simd.trailing_zeros(todo)
        todo &= todo - 1
        at = block * _LANES
        dx, dy = splat[0] + simd.load(grid, at), splat[1] + simd.load(grid, layout.PIXELS + at)
        p, q = _whiten(splat, dx, dy)
        before = simd.load(transmittance, at)
        _, alpha, reached, seen, is_open, left = _blend(splat, p, q, before, alpha_max, stop)
        if simd.bits(reached & (before > zero)) == 0:
            continue
        hit |= 1 << block
        simd.store(transmittance, at, left)
        if simd.bits(is_open) == 0:
            live &= ~(1 << block)
        weight = simd.select(seen, before * alpha, zero)
        for c in range(simd.length(count)):
            # Where the splat is not seen, a colour that is not finite must not be multiplied by zero.
            _add(planes, c * layout.PIXELS + at, simd.select(seen, weight * simd.full(colors[n, c]), zero))
        _add(planes, simd.length(count) * layout.PIXELS + at, weight * depth)
        _add(planes, (simd.length(count) + 1) * layout.PIXELS + at, weight)
    return hit, live


@helper
def _place(tile, tiles_x, tiles_y, height, width):
    """View of a tile, its first column and row, the image's rows and columns in it, its first pixel."""
    view, inner = tile // (tiles_x * tiles_y), tile % (tiles_x * tiles_y)
    y0, x0 = inner // tiles_x * layout.TILE, inner % tiles_x * layout.TILE
    rows, columns = min(layout.TILE, height - y0), min(layout.TILE, width - x0)
    return view, x0, y0, rows, columns, y0 * width + x0


@helper
def _prefetch(splats, entry, end, shift, records, colors):
    """Ask for what a later entry needs: a tile's splats may lie anywhere in memory."""
    s = splats[min(entry + _AHEAD, end - 1)]
    simd.prefetch(records, s * layout.RECORD)
    simd.prefetch(colors, (s + shift) * colors.shape[1])


@kernel
def forward(
    tiles, tiles_x, tiles_y, height, width, views, tile_starts, splats, shifts, records, colors, count,
    alpha_max, stop, hits, image, alpha, depth,
):  # fmt: skip
    """Blend the given ``tiles`` into flat ``image`` [V C h w], ``alpha`` and (expected) ``depth`` [V h w].

    ``hits`` [entries] receives the blocks that each entry reached, for the backward pass. ``count`` is
    the number of channels, or a tuple of that length, for which the kernel is then compiled.
    """
    channels = simd.length(count)
    transmittance, planes = simd.aligned(layout.PIXELS), simd.aligned((channels + 2) * layout.PIXELS)
    grid, alpha_max, stop = _grid(), simd.full(alpha_max), simd.full(stop)
    for tile in tiles:
        view, x0, y0, rows, columns, first = _place(tile, tiles_x, tiles_y, height, width)
        planes[:] = _ZERO
        live = _open(views, view, x0, y0, grid, transmittance)
        for entry in range(tile_starts[tile], tile_starts[tile + 1]):
            hit = 0
            if live != 0:
                _prefetch(splats, entry, tile_starts[tile + 1], shifts[view], records, colors)
                s = splats[entry]
                hit, live = _forward_splat(
                    records, s, colors, s + shifts[view], count, x0, y0, live, grid, planes, transmittance,
                    alpha_max, stop
                )  # fmt: skip
            hits[entry] = hit
        for block in range(_BLOCKS):
            at = block * _LANES
            for c in range(channels):
                start = (view * channels + c) * height * width + first
                _write(image, start, width, rows, columns, block, simd.load(planes, c * layout.PIXELS + at))
            total = simd.load(planes, (channels + 1) * layout.PIXELS + at)
            start = view * height * width + first
            _write(alpha, start, width, rows, columns, block, total)
            expected = simd.load(planes, channels * layout.PIXELS + at) / simd.maximum(
                total, simd.full(_LEAST_ALPHA)
            )
            _write(depth, start, width, rows, columns, block, expected)


@helper
def _read_gradients(
    view, first, height, width, rows, columns, count, image, alpha, depth, d_image, d_alpha, d_depth,
    upstream, suffix,
):  # fmt: skip
    """Fill ``upstream`` with the gradients of a tile's planes and ``suffix`` with ``S`` of all splats.

    Gradients of alpha and depth may be absent (of size 0). With depth = D / A, ``dL/dD = g / A`` and
    ``dL/dA = -g depth / A``; so D's and A's shares of ``S`` cancel.
    """
    channels, start = simd.length(count), view * height * width + first
    for block in range(_BLOCKS):
        at = block * _LANES
        total, d_sum, d_total = simd.full(_ZERO), simd.full(_ZERO), simd.full(_ZERO)
        for c in range(channels):
            plane = (view * channels + c) * height * width + first
            slope = _read(d_image, plane, width, rows, columns, block)
            total = simd.fma(slope, _read(image, plane, width, rows, columns, block), total)
            simd.store(upstream, c * layout.PIXELS + at, slope)
        seen = _read(alpha, start, width, rows, columns, block)
        if len(d_alpha) > 0:
            d_total = _read(d_alpha, start, width, rows, columns, block)
            total = simd.fma(d_total, seen, total)
        if len(d_depth) > 0:
            least, slope = simd.full(_LEAST_ALPHA), _read(d_depth, start, width, rows, columns, block)
            d_sum = slope / simd.maximum(seen, least)
            product = slope * _read(depth, start, width, rows, columns, block)
            free = seen > least
            d_total = simd.select(free, d_total - product / seen, d_total)
            total = simd.select(free, total, total + product)
        simd.store(upstream, channels * layout.PIXELS + at, d_sum)
        simd.store(upstream, (channels + 1) * layout.PIXELS + at, d_total)
        simd.store(suffix, at, total)


@helper
def _backward_splat(
    records, s, colors, n, count, x0, y0, hit, grid, transmittance, upstream, suffix, sums, alpha_max, stop
):
    """Sum one splat's gradients over a tile into the rows of ``sums``."""
    channels = simd.length(count)
    zero, one = simd.full(_ZERO), simd.full(_ONE)
    splat, depth = _splat(records, s, x0, y0), simd.full(records[s, layout.DEPTH])
    h, h_p, h_q, h_pp, h_pq, h_qq, d_depth = zero, zero, zero, zero, zero, zero, zero
    for c in range(channels):
        simd.store(sums, (layout.COLOR + c) * _LANES, zero)
    while hit != 0:
        block = simd.trailing_zeros(hit)
        hit &= hit - 1
        at = block * _LANES
        dx, dy = splat[0] + simd.load(grid, at), splat[1] + simd.load(grid, layout.PIXELS + at)
        p, q = _whiten(splat, dx, dy)
        before = simd.load(transmittance, at)
        raw, alpha, _, seen, _, left = _blend(splat, p, q, before, alpha_max, stop)
        simd.store(transmittance, at, left)
        weight = simd.select(seen, before * alpha, zero)
        d_sum = simd.load(upstream, channels * layout.PIXELS + at)
        value = simd.fma(d_sum, depth, simd.load(upstream, (channels + 1) * layout.PIXELS + at))
        d_depth = simd.fma(weight, d_sum, d_depth)
        for c in range(channels):
            slope = simd.load(upstream, c * layout.PIXELS + at)
            value = simd.fma(slope, simd.full(colors[n, c]), value)
            row = (layout.COLOR + c) * _LANES
            simd.store(sums, row, simd.fma(weight, slope, simd.load(sums, row)))
        rest = simd.load(suffix, at) - simd.select(seen, weight * value, zero)
        simd.store(suffix, at, rest)
        # dL / d ln(alpha), where alpha is not clamped.
        slope = alpha * (before * value - rest / (one - alpha))
        slope = simd.select(seen & (raw < alpha_max), slope, zero)
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
    tiles, tiles_x, tiles_y, height, width, views, tile_starts, splats, slots, shifts,
    records, colors, count,
    alpha_max, stop, hits, image, alpha, depth, d_image, d_alpha, d_depth, gradients,
):  # fmt: skip
    """Gradients of every entry of the given ``tiles`` into ``gradients`` [entries x gradient_width].

    ``gradients`` is flat and starts on a cache line; images and their gradients are flat as in
    ``forward``.
    """
    channels = simd.length(count)
    transmittance, suffix = simd.aligned(layout.PIXELS), simd.aligned(layout.PIXELS)
    upstream = simd.aligned((channels + 2) * layout.PIXELS)
    stride = (layout.COLOR + channels + _LANES - 1) // _LANES * _LANES
    sums = simd.aligned(stride * _LANES)
    sums[:] = _ZERO
    grid, alpha_max, stop = _grid(), simd.full(alpha_max), simd.full(stop)
    for tile in tiles:
        view, x0, y0, rows, columns, first = _place(tile, tiles_x, tiles_y, height, width)
        _read_gradients(
            view, first, height, width, rows, columns, count, image, alpha, depth, d_image, d_alpha,
            d_depth, upstream, suffix,
        )  # fmt: skip
        _open(views, view, x0, y0, grid, transmittance)
        for entry in range(tile_starts[tile], tile_starts[tile + 1]):
            _prefetch(splats, entry, tile_starts[tile + 1], shifts[view], records, colors)
            simd.prefetch(gradients, slots[min(entry + _AHEAD, tile_starts[tile + 1] - 1)] * stride)
            s, hit, slot = splats[entry], np.int64(hits[entry]), slots[entry] * stride
            if hit == 0:
                for k in range(0, stride, _LANES):
                    simd.store(gradients, slot + k, simd.full(_ZERO))
                continue
            _backward_splat(
                records, s, colors, s + shifts[view], count, x0, y0, hit, grid, transmittance, upstream,
                suffix, sums, alpha_max, stop,
            )  # fmt: skip
            for k in range(0, stride, _LANES):
                simd.store(gradients, slot + k, simd.row_sums(sums, k * _LANES, count))
