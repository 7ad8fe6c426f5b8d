"""Plane sweep of 16 pixels of four channels at once (see
:mod:`ghgs_lit.ops.photo_consistency`)."""

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
    """``low + share (high - low)`` for vectors of any length.

    Args:
        builder: of LLVM instructions.
        low: a vector, as is the next.
        high: of the same length.
        share: a number.

    Returns:
        The vector.
    """
    kind = low.type
    share = everywhere(builder, share, low.type.count)
    function = ir.FunctionType(kind, [kind] * 3)
    callee = cgutils.get_or_insert_function(builder.module, function, f"llvm.fmuladd.v{kind.count}f32")
    return builder.call(callee, [share, builder.fsub(high, low), low])


@intrinsic
def interpolate(typing_context, pixels, at, line, right, down, out, place):
    """Write the bilinear interpolation of four pixels; the two pixels of a line are loaded at once.

    Args:
        typing_context: Numba's.
        pixels: flat array of pixels, channels innermost.
        at: where the first pixel is in it.
        line: how many numbers later the pixel below it is.
        right: weight of the pixels to the right, in [0, 1].
        down: weight of the pixels below, in [0, 1].
        out: array for the channels of the result.
        place: where they start in it, a multiple of :data:`CHANNELS`.
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
    """The channels of 16 pixels, one vector per channel.

    Args:
        typing_context: Numba's.
        pixels: flat array of pixels, channels innermost.
        at: where the first pixel is in it.

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
    """Write the indices of the first channels of 16 pixels.

    Args:
        typing_context: Numba's.
        places: int32 array for the indices.
        at: where they start in it.
        row: vector of whole rows, as floats.
        column: vector of whole columns, as floats.
        line: numbers in a row of pixels.
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
        out: the flat array, zeros at first.
        image: number of the image.
        first: first row.
        last: row after the last one.
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

    Points outside the image or behind the camera, and NaN, are put into the rim,
    where the mask is 0.

    Args:
        rays: what a unit of depth adds to the homogeneous pixel: three vectors.
        shift: that of the camera's centre [3].
        depth: vector of depths.
        height: of the image, as is the next.
        width: of the image.
        places: int32 array [16] for the indices of the pixels to the upper left.
        rights: array [16] for the weights of the next pixels to the right.
        downs: array [16] for those of the pixels below.
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
    """Load 16 pixels; the last one fills up the vectors.

    Args:
        colors: all views, of :func:`smoothed`.
        pixels: indices among those of all images.
        near: least depth of each.
        far: largest depth of each.
        start: number of the first of the 16 pixels.
        last: number after the last pixel.
        height: of the image, as is the next.
        width: of the image.
        begin: where the pixels' image starts in ``colors``.
        values: array [4 * 16] for u and v of the centres, near, and far - near.
        centers: array [16 * 4] for the colours.
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
        colors: all views, of :func:`smoothed`.
        pixels: ascending indices among those of all images [N].
        near: least depth of each [N].
        far: largest depth of each [N].
        turn: matrices from pixels of a view (second axis) to another (third axis) [B, V, V, 3, 3].
        shift: what is added in the other view [B, V, V, 3].
        compared: whether two views are compared [B, V, V].
        shares: fractions of the way from near to far [S].
        tolerance: mean difference of colours at which the agreement is 1 / e.
        out: array [N, S] for the agreement.
        height: of an image, as is the next.
        width: of an image.
        image: number of the pixels' image.
        first: number of the first pixel.
        last: number after the last one.
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
    """The operator of :mod:`ghgs_lit.ops.photo_consistency`, as one flat array.

    Args:
        photo: colours of the surface [B, V, 3, H, W].
        masks: of the subject [B, V, H, W].

    Returns:
        Channels are innermost. A rim of zeros surrounds each photograph, and the end is padded for
        reads of whole vectors.
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
    """The operator of :mod:`ghgs_lit.ops.photo_consistency`.

    Args:
        pixels: ascending indices among those of all images [N].
        near: least depth of each [N].
        far: largest depth of each [N].
        colors: all views, of :func:`smoothed`.
        turn: matrices from pixels of a view to another [B, V, V, 3, 3].
        shift: what is added in the other view [B, V, V, 3].
        compared: whether two views are compared [B, V, V].
        height: of an image, as is the next.
        width: of an image.
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
