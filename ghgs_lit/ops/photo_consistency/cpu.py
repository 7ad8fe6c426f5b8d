"""CPU kernels of the plane sweep, 16 pixels of four channels at once; see
:mod:`ghgs_lit.ops.photo_consistency`."""

import math
from itertools import pairwise

import numpy as np
import torch
from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic
from torch import Tensor

from ghgs_lit.geometry.constants import constant, middles
from ghgs_lit.ops import memory, pool, simd
from ghgs_lit.ops.compile import FLOATS, NUMBER, helper, kernel_for
from ghgs_lit.ops.memory import pointer_to
from ghgs_lit.ops.simd import EXP2_LIMIT, I32, LANES, everywhere, floats, indices

#: Channels of a pixel.
CHANNELS = 4


def _vector(count: int) -> ir.VectorType:
    return ir.VectorType(ir.FloatType(), count)


def _between(builder, low, high, share):
    """Emit ``low + share (high - low)`` for two vectors of the same length and a number ``share``."""
    kind = low.type
    share = everywhere(builder, share, low.type.count)
    function = ir.FunctionType(kind, [kind] * 3)
    callee = cgutils.get_or_insert_function(builder.module, function, f"llvm.fmuladd.v{kind.count}f32")
    return builder.call(callee, [share, builder.fsub(high, low), low])


@intrinsic
def interpolate(typing_context, pixels, at, line, right, down, out, place):
    """Write the bilinear interpolation of four pixels; the two pixels of a row are loaded at once.

    Args:
        typing_context: Numba's.
        pixels: flat array of pixels, channels innermost.
        at: offset of the upper left pixel.
        line: distance to the pixel below it, in numbers.
        right: weight of the pixels to the right, in [0, 1].
        down: weight of the pixels below, in [0, 1].
        out: written, the channels of the result.
        place: offset in ``out``, a multiple of :data:`CHANNELS`.
    """

    def emit(context, builder, sig, args):
        pair = _vector(2 * CHANNELS)
        array = sig.args[0]
        index = args[1]
        below = builder.add(args[1], args[2])
        lines = [
            builder.load(pointer_to(context, builder, array, args[0], i, types.intp, pair), align=4)
            for i in (index, below)
        ]
        column = _between(builder, *lines, args[4])
        sides = (
            builder.shuffle_vector(column, column, indices(range(k, k + CHANNELS))) for k in (0, CHANNELS)
        )
        target = pointer_to(context, builder, out, args[5], args[6], place, _vector(CHANNELS))
        builder.store(_between(builder, *sides, args[3]), target, align=16)
        return context.get_dummy_value()

    number = types.float32
    return types.void(pixels, types.intp, types.intp, number, number, out, place), emit


@intrinsic
def channels_of(typing_context, pixels, at):
    """Load 16 pixels as one vector per channel.

    Args:
        typing_context: Numba's.
        pixels: flat array of pixels, channels innermost.
        at: offset of the first pixel.

    Returns:
        :data:`CHANNELS` vectors.
    """

    def emit(context, builder, sig, args):
        address = pointer_to(context, builder, pixels, *args, at, _vector(LANES * CHANNELS))
        lines = builder.load(address, align=64)
        each = [
            builder.shuffle_vector(lines, lines, indices(range(k, LANES * CHANNELS, CHANNELS)))
            for k in range(CHANNELS)
        ]
        return context.make_tuple(builder, sig.return_type, each)

    return types.UniTuple(floats, CHANNELS)(pixels, at), emit


@intrinsic
def store_places(typing_context, places, at, row, column, line):
    """Write the offsets of 16 pixels in a flat image with channels innermost.

    Args:
        typing_context: Numba's.
        places: written, int32.
        at: position in ``places``.
        row: vector of rows, integers stored as floats.
        column: vector of columns, integers stored as floats.
        line: number of values in a row of pixels.
    """

    def emit(context, builder, sig, args):
        integers = ir.VectorType(I32, LANES)
        row, column = (builder.fptosi(values, integers) for values in args[2:4])
        line = everywhere(builder, builder.trunc(args[4], I32), LANES)
        column = builder.mul(column, ir.Constant(integers, [CHANNELS] * LANES))
        target = pointer_to(context, builder, places, *args[:2], at, integers)
        builder.store(builder.add(builder.mul(row, line), column), target, align=4)
        return context.get_dummy_value()

    return types.void(places, at, floats, floats, types.intp), emit


ZERO, HALF, ONE, THREE = (np.float32(x) for x in (0, 0.5, 1, 3))

PIXELS = types.Array(types.int64, 1, "C")
MASKS = types.Array(types.boolean, 3, "C")
_SWEPT = (FLOATS[1], PIXELS, FLOATS[1], FLOATS[1], FLOATS[5], FLOATS[4], MASKS, FLOATS[1])


@kernel_for(FLOATS[4], MASKS, FLOATS[1], NUMBER, NUMBER, NUMBER)
def smooth_rows(photo, masks, out, image, first, last):
    """Write some rows of an image; see :func:`smoothed`.

    Args:
        photo: colours of all images [m, 3, H, W].
        masks: [m, H, W].
        out: written, the flat array, initially zeros.
        image: index of the image.
        first: first row.
        last: end of the rows, excluded.
    """
    height = masks.shape[1]
    width = masks.shape[2]
    for row in range(first, last):
        top = max(row - 1, 0)
        bottom = min(row + 2, height)
        if not masks[image, top:bottom].any():
            continue
        for column in range(width):
            red = ZERO
            green = ZERO
            blue = ZERO
            count = ZERO
            at = ((image * (height + 2) + row + 1) * (width + 2) + column + 1) * CHANNELS
            for y in range(top, bottom):
                for x in range(max(column - 1, 0), min(column + 2, width)):
                    if not masks[image, y, x]:
                        continue
                    r = photo[image, 0, y, x]
                    g = photo[image, 1, y, x]
                    b = photo[image, 2, y, x]
                    if np.isfinite(r + g + b):
                        red = red + r
                        green = green + g
                        blue = blue + b
                        count = count + ONE
                        if y == row and x == column:
                            out[at + 3] = ONE
            if count > ZERO:
                out[at], out[at + 1], out[at + 2] = red / count, green / count, blue / count


@helper
def _rays(turn, u, v):
    return (
        turn[0, 0] * u + (turn[0, 1] * v + turn[0, 2]),
        turn[1, 0] * u + (turn[1, 1] * v + turn[1, 2]),
        turn[2, 0] * u + (turn[2, 1] * v + turn[2, 2]),
    )


@helper
def _project(rays, shift, depth, height, width, places, rights, downs):
    """Project points of rays into an image.

    Points outside the image or behind the camera, and NaN, are moved to the image's rim, where the
    mask is 0.

    Args:
        rays: change of the homogeneous pixel per unit of depth, three vectors.
        shift: homogeneous pixel of the rays' origin [3].
        depth: vector of depths.
        height: image height in pixels.
        width: image width in pixels.
        places: written, offsets of the upper left pixels, int32 [16].
        rights: written, weights of the pixels to the right [16].
        downs: written, weights of the pixels below [16].
    """
    z = simd.fma(rays[2], depth, shift[2])
    inverse = ONE / z
    x = simd.fma(rays[0], depth, shift[0]) * inverse - HALF
    y = simd.fma(rays[1], depth, shift[1]) * inverse - HALF
    seen = (z > ZERO) & (x > -ONE) & (x < np.float32(width)) & (y > -ONE) & (y < np.float32(height))
    x = simd.select(seen, x, -ONE)
    y = simd.select(seen, y, -ONE)
    left = simd.floor(x)
    top = simd.floor(y)
    memory.store(rights, 0, x - left)
    memory.store(downs, 0, y - top)
    store_places(places, 0, top + ONE, left + ONE, (width + 2) * CHANNELS)


@helper
def _difference(first, second):
    return simd.maximum(first - second, second - first)


@helper
def _load_pixels(colors, pixels, near, far, start, last, height, width, begin, values, centers):
    """Load 16 pixels, padded with the last one.

    Args:
        colors: all views, from :func:`smoothed`.
        pixels: indices among the pixels of all images.
        near: smallest depth of each pixel.
        far: largest depth of each pixel.
        start: first of the 16 pixels.
        last: end of the pixels, excluded.
        height: image height in pixels.
        width: image width in pixels.
        begin: offset of the pixels' image in ``colors``.
        values: written, u and v of the centres, near, and far - near [4 * 16].
        centers: written, the colours [16 * 4].
    """
    for lane in range(LANES):
        i = min(start + lane, last - 1)
        place = pixels[i] % (height * width)
        row = place // width
        column = place % width
        values[lane], values[LANES + lane] = np.float32(column) + HALF, np.float32(row) + HALF
        values[2 * LANES + lane], values[3 * LANES + lane] = near[i], far[i] - near[i]
        at = begin + ((row + 1) * (width + 2) + column + 1) * CHANNELS
        for channel in range(CHANNELS):
            centers[lane * CHANNELS + channel] = colors[at + channel]


@kernel_for(*_SWEPT, types.float32, FLOATS[2], *[NUMBER] * 5)
def sweep_pixels(
    colors, pixels, near, far, turn, shift, compared, shares, tolerance, out, height, width, image, first,
    last,
):  # fmt: skip
    """Write the agreement of some pixels of an image; see :func:`swept`.

    Args:
        colors: all views, from :func:`smoothed`.
        pixels: ascending indices among the pixels of all images [N].
        near: smallest depth of each pixel [N].
        far: largest depth of each pixel [N].
        turn: matrices from pixels of a view (second axis) to another (third axis) [B, V, V, 3, 3].
        shift: added in the other view [B, V, V, 3].
        compared: whether two views are compared [B, V, V].
        shares: depths as fractions of the interval from near to far [S].
        tolerance: mean difference of colours at which the agreement is 1 / e.
        out: written, the agreement [N, S].
        height: image height in pixels.
        width: image width in pixels.
        image: index of the pixels' image.
        first: first pixel.
        last: end of the pixels, excluded.
    """
    views = turn.shape[1]
    element = image // views
    view = image % views
    line = (width + 2) * CHANNELS
    size = (height + 2) * line
    rate = np.float32(math.log2(math.e)) / (THREE * tolerance)
    values = simd.aligned(4 * LANES)
    centers = simd.aligned(4 * LANES)
    shown = simd.aligned(4 * LANES)
    rights = simd.aligned(LANES)
    downs = simd.aligned(LANES)
    places = np.empty(LANES, np.int32)
    best = simd.aligned(len(shares) * LANES)
    for start in range(first, last, LANES):
        _load_pixels(colors, pixels, near, far, start, last, height, width, image * size, values, centers)
        u = memory.load(values, 0)
        v = memory.load(values, LANES)
        low = memory.load(values, 2 * LANES)
        length = memory.load(values, 3 * LANES)
        red, green, blue, _ = channels_of(centers, 0)
        best[:] = ZERO
        for other in range(views):
            if other == view or not compared[element, view, other]:
                continue
            rays = _rays(turn[element, view, other], u, v)
            moved = shift[element, view, other]
            begin = (element * views + other) * size
            for s in range(len(shares)):
                depth = simd.fma(length, shares[s], low)
                _project(rays, moved, depth, height, width, places, rights, downs)
                for lane in range(LANES):
                    interpolate(
                        colors, begin + places[lane], line, rights[lane], downs[lane], shown, lane * CHANNELS
                    )
                r, g, b, seen = channels_of(shown, 0)
                difference = _difference(r, red) + _difference(g, green) + _difference(b, blue)
                exponent = simd.minimum(simd.full(EXP2_LIMIT), difference * rate)
                agreement = seen * simd.exp2_minus(exponent)
                memory.store(best, s * LANES, simd.maximum(memory.load(best, s * LANES), agreement))
        for lane in range(min(LANES, last - start)):
            for s in range(len(shares)):
                out[start + lane, s] = best[s * LANES + lane]


_PIXELS = 1024  #: Pixels in one task
_ROWS = 64  #: Rows of an image in one task


def smoothed(photo: Tensor, masks: Tensor) -> Tensor:
    """Kernel of the operator ``smoothed`` of :mod:`ghgs_lit.ops.photo_consistency`.

    Args:
        photo: colours of the surface [B, V, 3, H, W].
        masks: foreground [B, V, H, W].

    Returns:
        A flat array with channels innermost, in which a rim of zeros surrounds each image; the end is
        padded for reads of whole vectors.
    """
    elements, views, height, width = masks.shape
    flat = photo.new_zeros(elements * views * (height + 2) * (width + 2) * 4 + LANES)
    arrays = [x.flatten(0, 1).contiguous().numpy() for x in (photo, masks)]
    ranges = [(image, 0, height) for image in range(elements * views)]
    pool.run_rows(smooth_rows(), (*arrays, flat.numpy()), ranges, _ROWS, masks.numel() // 8)
    return flat


def swept(
    pixels: Tensor, near: Tensor, far: Tensor, colors: Tensor, turn: Tensor, shift: Tensor,
    compared: Tensor, height: int, width: int, steps: int, tolerance: float,
) -> Tensor:  # fmt: skip
    """Kernel of the operator ``swept`` of :mod:`ghgs_lit.ops.photo_consistency`.

    Args:
        pixels: ascending indices among the pixels of all images [N].
        near: smallest depth of each pixel [N].
        far: largest depth of each pixel [N].
        colors: all views, from :func:`smoothed`.
        turn: matrices from pixels of a view to another [B, V, V, 3, 3].
        shift: added in the other view [B, V, V, 3].
        compared: whether two views are compared [B, V, V].
        height: image height in pixels.
        width: image width in pixels.
        steps: S, the number of depths.
        tolerance: mean difference of colours at which the agreement is 1 / e.

    Returns:
        [N, S] in [0, 1].
    """
    result = np.empty((len(pixels), steps), np.float32)
    given = (colors, pixels, near, far, turn, shift, compared, constant(middles, steps, like=near))
    tables = [x.detach().contiguous().numpy() for x in given]
    images = np.arange(compared[..., 0].numel() + 1) * (height * width)
    ends = np.searchsorted(tables[1], images).tolist()
    ranges = [(image, *pair) for image, pair in enumerate(pairwise(ends))]
    numbers = (tolerance, result, height, width)
    pool.run_rows(sweep_pixels(), (*tables, *numbers), ranges, _PIXELS, result.size)
    return torch.from_numpy(result)
