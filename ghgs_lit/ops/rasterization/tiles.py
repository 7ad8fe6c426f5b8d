"""Rendering of a tile: what the forward and the backward pass share.

A tile is 16 x 16 pixels in 16 blocks of 4 x 4; a block is one vector. Most splats are small (one per
input pixel) and fit a 4 x 4 block better than a row of 16. The planes of a tile are its three colour
channels, the sum of ``w z`` and the sum of ``w``."""

import numpy as np

from ghgs_lit.ops import memory, simd
from ghgs_lit.ops.compile import helper
from ghgs_lit.ops.rasterization import layout

LANES = simd.LANES
BLOCKS = layout.PIXELS // LANES
PLANES = layout.CHANNELS + 2
ZERO = np.float32(0)
ONE = np.float32(1)
STOP = np.float32(layout.STOP)
# Smallest denominator of the expected depth; for smaller alphas depth has no gradient in alpha.
LEAST_ALPHA = np.float32(1e-10)


@helper
def grid():
    """Columns, then rows of a tile's pixels, block by block, [2 PIXELS]."""
    pixels = simd.aligned(2 * layout.PIXELS)
    for pixel in range(layout.PIXELS):
        block = pixel // LANES
        lane = pixel % LANES
        pixels[pixel] = block % 4 * 4 + lane % 4
        pixels[layout.PIXELS + pixel] = block // 4 * 4 + lane // 4
    return pixels


@helper
def place(tile, tiles_x, tiles_y, height, width):
    """Locate a tile.

    Args:
        tile: index among the tiles of all views.
        tiles_x: number of tiles across a view.
        tiles_y: number of tiles down a view.
        height: image height in pixels.
        width: image width in pixels.

    Returns:
        View, first column, first row, number of rows and of columns inside the image, and index of the
        first pixel in a plane of the image.
    """
    view = tile // (tiles_x * tiles_y)
    inner = tile % (tiles_x * tiles_y)
    y0 = inner // tiles_x * layout.TILE
    x0 = inner % tiles_x * layout.TILE
    rows = min(layout.TILE, height - y0)
    columns = min(layout.TILE, width - x0)
    return view, x0, y0, rows, columns, y0 * width + x0


@helper
def open_pixels(view, x0, y0, pixels, transmittance):
    """Set the transmittance to 1 in pixels of the image and to 0 outside.

    Args:
        view: a camera, [VIEW].
        x0: first column of the tile, in pixels.
        y0: first row of the tile, in pixels.
        pixels: coordinates of the tile's pixels, from :func:`grid`.
        transmittance: written, [PIXELS], block by block.

    Returns:
        Bit mask of the blocks that have pixels in the image.
    """
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
    """Numbers of a splat relative to a tile.

    Args:
        record: one splat's record [RECORD], or a tuple with a vector for each of its numbers.
        x0: first column of the tile, in pixels.
        y0: first row of the tile, in pixels.

    Returns:
        Vector from the splat's centre to the centre of the tile's first pixel (2), ``K`` (3), opacity
        and cutoff.
    """
    x = x0 - record[layout.COLUMN]
    y = y0 - record[layout.ROW]
    return (
        x + record[layout.REST_X], y + record[layout.REST_Y], record[layout.K_XX], record[layout.K_YX],
        record[layout.K_YY], record[layout.OPACITY], record[layout.CUTOFF],
    )  # fmt: skip


@helper
def whiten(numbers, dx, dy):
    """Whitened coordinates ``p`` and ``q`` of vectors from a splat's centre (see ``layout``).

    Args:
        numbers: from :func:`read_splat`.
        dx: pixels across.
        dy: pixels down.
    """
    return numbers[2] * dx, simd.fma(numbers[3], dx, numbers[4] * dy)


@helper
def blend(numbers, p, q, before, alpha_max):
    """Blend a splat into a block of pixels.

    Masked lanes hold zeros, so that whole vectors are stored: a masked store could not be forwarded
    to the next splat's load.

    Args:
        numbers: from :func:`read_splat`.
        p: first whitened coordinate of the pixels.
        q: second whitened coordinate of the pixels.
        before: transmittance in front of the splat.
        alpha_max: upper limit of alpha.

    Returns:
        The unclamped alpha; the clamped alpha; the masks of lanes that the splat reaches, where it is
        visible, and where the pixel is not yet terminated; and the transmittance behind the splat.
        Where that would fall to ``STOP``, the splat is skipped and the transmittance becomes 0, which
        excludes all splats behind.
    """
    squared = simd.fma(p, p, q * q)
    reached = squared <= numbers[6]
    # Clamp lanes out of reach to the cutoff: denormal numbers would be slow.
    raw = numbers[5] * simd.exp2_minus(simd.minimum(squared, numbers[6]))
    alpha = simd.select(reached, simd.minimum(raw, alpha_max), ZERO)
    behind = before - before * alpha
    is_open = behind > STOP
    return raw, alpha, reached, reached & is_open, is_open, simd.select(is_open, behind, ZERO)
