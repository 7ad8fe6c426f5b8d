"""Parts of drawing a tile that the forward and the backward pass share. A tile is 16 x 16 pixels in 16 blocks
of 4 x 4; a block is one vector. Most splats are small (one for each input pixel) and fit a 4 x 4 block better
than a row of 16. The planes of a tile are its colour channels, the sum of ``w z`` and the sum of ``w``."""

import numpy as np

from ghgs_lit.kernels import memory, simd
from ghgs_lit.kernels.compile import helper
from ghgs_lit.rendering.cpu import layout

LANES = simd.LANES
BLOCKS = layout.PIXELS // LANES
ZERO = np.float32(0)
ONE = np.float32(1)
# Smallest denominator of the expected depth; for smaller alphas depth has no gradient in alpha.
LEAST_ALPHA = np.float32(1e-10)


@helper
def grid():
    """Columns, then rows of a tile's pixels, block by block."""
    pixels = simd.aligned(2 * layout.PIXELS)
    for pixel in range(layout.PIXELS):
        block = pixel // LANES
        lane = pixel % LANES
        pixels[pixel] = block % 4 * 4 + lane % 4
        pixels[layout.PIXELS + pixel] = block // 4 * 4 + lane // 4
    return pixels


@helper
def place(tile, tiles_x, tiles_y, height, width):
    """View, first column and row, rows and columns in the image, and index of the first pixel of a tile."""
    view = tile // (tiles_x * tiles_y)
    inner = tile % (tiles_x * tiles_y)
    y0 = inner // tiles_x * layout.TILE
    x0 = inner % tiles_x * layout.TILE
    rows = min(layout.TILE, height - y0)
    columns = min(layout.TILE, width - x0)
    return view, x0, y0, rows, columns, y0 * width + x0


@helper
def open_pixels(view, x0, y0, pixels, transmittance):
    """Set the transmittance to 1 in pixels of the image, to 0 beyond; returns their blocks, as bits."""
    live = 0
    right = simd.full(np.float32(view[layout.RIGHT] - x0))
    bottom = simd.full(np.float32(view[layout.BOTTOM] - y0))
    for block in range(BLOCKS):
        at = block * LANES
        x = memory.load(pixels, at)
        y = memory.load(pixels, layout.PIXELS + at)
        within = (x <= right) & (y <= bottom)
        memory.store(transmittance, at, simd.select(within, simd.full(ONE), ZERO))
        if simd.bits(within) != 0:
            live |= 1 << block
    return live


@helper
def read_splat(record, x0, y0):
    """Vector from a splat's centre to the tile's first pixel (2), ``K`` (3), opacity and cutoff."""
    x = x0 - record[layout.COLUMN]
    y = y0 - record[layout.ROW]
    return (
        x + record[layout.REST_X], y + record[layout.REST_Y], record[layout.K_XX], record[layout.K_YX],
        record[layout.K_YY], record[layout.OPACITY], record[layout.CUTOFF],
    )  # fmt: skip


@helper
def color(records, s, colors, n, c, count):
    """Channel ``c`` of ``count`` of splat ``s``, which is Gaussian ``n``."""
    if simd.length(count) <= layout.ROOM:
        return records[s, layout.COLORS + c]
    return colors[n, c]


@helper
def prefetch(records, s, colors, n):
    """Prefetch splat ``s``, which is Gaussian ``n``: splats of a tile may lie anywhere in memory."""
    memory.prefetch(records, s * layout.RECORD)
    if colors.shape[1] > layout.ROOM:
        memory.prefetch(colors, n * colors.shape[1])


@helper
def whiten(numbers, dx, dy):
    """Whitened coordinates ``p`` and ``q`` of the vector (dx, dy) from a splat's centre."""
    return numbers[2] * dx, simd.fma(numbers[3], dx, numbers[4] * dy)


@helper
def blend(numbers, p, q, before, alpha_max, stop):
    """Blend a splat over a block of pixels with transmittance ``before``.

    Returns the unclamped and the clamped alpha; the lanes that the splat reaches, where it is seen, and that
    stay open; and the transmittance behind it. Where that would fall to ``stop``, the splat is left out and
    the transmittance becomes 0, which excludes all splats behind. Masked lanes hold zeros, so that vectors
    are stored whole: a masked store could not be forwarded to the next splat's load."""
    squared = simd.fma(p, p, q * q)
    reached = squared <= numbers[6]
    # Lanes out of reach are clamped to the cutoff: denormal numbers would be slow.
    raw = numbers[5] * simd.exp2_minus(simd.minimum(squared, numbers[6]))
    alpha = simd.select(reached, simd.minimum(raw, alpha_max), ZERO)
    behind = before - before * alpha
    is_open = behind > stop
    return raw, alpha, reached, reached & is_open, is_open, simd.select(is_open, behind, ZERO)
