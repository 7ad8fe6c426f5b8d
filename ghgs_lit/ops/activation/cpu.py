"""CPU kernel of :func:`ghgs_lit.ops.activation.footprint_gaussians`, without a gradient.

It processes 16 Gaussians of one image at once; a line of ``values`` holds one number of each."""

import math
from itertools import pairwise
from typing import Any

import numpy as np
from numba.core import types
from torch import Tensor

from ghgs_lit.geometry.rotations import matrix_to_quaternion
from ghgs_lit.ops import memory, pool, simd
from ghgs_lit.ops.activation import OTHER, SAME, SIGMOID_LIMIT, TANH_LIMIT
from ghgs_lit.ops.compile import FLOATS, NUMBER, helper, kernel_for
from ghgs_lit.ops.simd import EXP2_LIMIT, LANES

ZERO, HALF, ONE, TWO = (np.float32(x) for x in (0, 0.5, 1, 2))
LOG2_E = np.float32(math.log2(math.e))
SIGMOID = np.float32(SIGMOID_LIMIT)
TANH = np.float32(TANH_LIMIT)
FAR = np.float32(OTHER)
RANGE = np.float32(OTHER - SAME)

# Lines: raw values, values at the pixel, and the depths to its right, to its left, below and above.
OFFSET = 0
SCALE = 3
ROTATION = 6
OPACITY = 10
COLOR = 11
DEPTH = 14
POINT = 15
PHOTO = 18
SHARE = 21
AROUND = 22
LINES = 26

PLACES = types.Array(types.int64, 1, "C")
MASKS = types.Array(types.boolean, 3, "C")
_EACH = [FLOATS[2], FLOATS[2], FLOATS[2], FLOATS[1], FLOATS[2]]
_MAPS = [FLOATS[3], MASKS, FLOATS[4], FLOATS[4], FLOATS[3], FLOATS[3], FLOATS[2]]
_CONSTANTS = (types.UniTuple(types.float32, 10), types.boolean)


@helper
def _line(values, line):
    return memory.load(values, line * LANES)


@helper
def _sigmoid(x):
    x = simd.minimum(SIGMOID, simd.maximum(ZERO - SIGMOID, x))
    shrunk = simd.exp2_minus(simd.maximum(x, ZERO - x) * LOG2_E)
    return simd.select(x < ZERO, shrunk, ONE) / (ONE + shrunk)


@helper
def _tanh(x):
    return simd.tanh(simd.minimum(TANH, simd.maximum(ZERO - TANH, x)))


@helper
def _exp(x):
    """The exponential of non-negative numbers."""
    return ONE / simd.exp2_minus(simd.minimum(simd.full(EXP2_LIMIT), x * LOG2_E))


@helper
def _unit(w, x, y, z):
    """Normalise 16 quaternions, where 0 stays 0; the largest number is divided out first against overflow
    and underflow."""
    largest = simd.maximum(simd.maximum(w, ZERO - w), simd.maximum(x, ZERO - x))
    largest = simd.maximum(largest, simd.maximum(simd.maximum(y, ZERO - y), simd.maximum(z, ZERO - z)))
    is_zero = largest == ZERO
    inverse = ONE / simd.select(is_zero, ONE, largest)
    w = w * inverse
    x = x * inverse
    y = y * inverse
    z = z * inverse
    squared = simd.select(is_zero, ONE, w * w + (x * x + (y * y + z * z)))
    inverse = ONE / simd.sqrt(squared)
    return w * inverse, x * inverse, y * inverse, z * inverse


@helper
def _multiply(p, q):
    """Product of two quaternions."""
    return (
        p[0] * q[0] - p[1] * q[1] - p[2] * q[2] - p[3] * q[3],
        p[0] * q[1] + p[1] * q[0] + p[2] * q[3] - p[3] * q[2],
        p[0] * q[2] - p[1] * q[3] + p[2] * q[0] + p[3] * q[1],
        p[0] * q[3] + p[1] * q[2] - p[2] * q[1] + p[3] * q[0],
    )


@helper
def _cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@helper
def _rotate(q, v):
    """Rotate the vector ``v`` by the unit quaternion ``q``."""
    axis = q[1], q[2], q[3]
    x, y, z = _cross(axis, v)
    twice = x + x, y + y, z + z
    a, b, c = _cross(axis, twice)
    return v[0] + q[0] * twice[0] + a, v[1] + q[0] * twice[1] + b, v[2] + q[0] * twice[2] + c


@helper
def _slope(values, line, own, footprint):
    """Relative depth change per pixel along an axis (see ``surface_axes``); the depths of the next pixels
    are in ``line``, those of the previous ones in the line after it."""
    after = _line(values, line) - own
    before = _line(values, line + 1) - own
    near_after = simd.minimum(ONE, (FAR - simd.maximum(after, ZERO - after) / footprint) / RANGE)
    near_before = simd.minimum(ONE, (FAR - simd.maximum(before, ZERO - before) / footprint) / RANGE)
    near_after = simd.maximum(near_after, ZERO)
    near_before = simd.maximum(near_before, ZERO)
    after = simd.select(near_after > ZERO, after, ZERO) * near_after
    before = simd.select(near_before > ZERO, before, ZERO) * near_before
    return (after - before) / ((ONE + near_after * near_before) * own + after + before)


@helper
def _axes(values, camera, turn, row, column, own):
    """Quaternions from surface axes to the world; see ``surface_axes``.

    Args:
        values: lines of the Gaussians.
        camera: intrinsics [3, 3] in pixels.
        turn: quaternion from camera axes to the world.
        row: rows of the pixels.
        column: columns of the pixels.
        own: depths of the Gaussians in metres.
    """
    footprint = own / camera[0, 0]
    right = _slope(values, AROUND, own, footprint)
    down = _slope(values, AROUND + 2, own, footprint)
    toward = ONE + right * (column + HALF - camera[0, 2]) + down * (row + HALF - camera[1, 2])
    x = ZERO - right * camera[0, 0]
    y = ZERO - right * camera[0, 1] - down * camera[1, 1]
    length = simd.sqrt(x * x + y * y + toward * toward)
    turned = _unit(length + toward, ZERO - y, x, simd.full(ZERO))
    return _multiply((turn[0], turn[1], turn[2], turn[3]), turned)


@helper
def _read(
    offset, scale, rotation, opacity, color, pixel, depth, valid, points, photo, share, image, start, last,
    values,
):  # fmt: skip
    """Fill ``values``, ``LINES`` lines, with 16 Gaussians, padded with the one before ``last``; inputs as
    in :func:`activate_rows`."""
    height = depth.shape[1]
    width = depth.shape[2]
    for lane in range(LANES):
        i = min(start + lane, last - 1)
        row = pixel[i] // width
        column = pixel[i] % width
        for k in range(3):
            values[(OFFSET + k) * LANES + lane] = offset[i, k]
            values[(SCALE + k) * LANES + lane] = scale[i, k]
            values[(COLOR + k) * LANES + lane] = color[i, k] if len(color) > 0 else ZERO
            values[(POINT + k) * LANES + lane] = points[image, row, column, k]
            values[(PHOTO + k) * LANES + lane] = photo[image, k, row, column]
        for k in range(4):
            values[(ROTATION + k) * LANES + lane] = rotation[i, k]
            y = row + (k == 2) - (k == 3)
            x = column + (k == 0) - (k == 1)
            inside = (y >= 0) & (y < height) & (x >= 0) & (x < width)
            around = depth[image, y, x] if inside and valid[image, y, x] else np.float32(np.inf)
            values[(AROUND + k) * LANES + lane] = around
        values[OPACITY * LANES + lane] = opacity[i]
        values[DEPTH * LANES + lane] = depth[image, row, column]
        values[SHARE * LANES + lane] = share[image, row, column] if len(share) > 0 else ONE


@kernel_for(*_EACH, PLACES, *_MAPS, *_CONSTANTS, *_EACH, NUMBER, NUMBER, NUMBER)
def activate_rows(
    offset, scale, rotation, opacity, color, pixel, depth, valid, points, photo, share, intrinsics, turns,
    constants, on_surface, means, quaternions, scales, opacities, colors, image, first, last,
):  # fmt: skip
    """Write Gaussians of one image; see :func:`activate`.

    Args:
        offset: raw [N, 3].
        scale: raw [N, 3].
        rotation: raw [N, 4].
        opacity: raw [N].
        color: raw [N, 3]; without rows: 0.
        pixel: row-major index of each Gaussian's pixel [N].
        depth: in metres [images, H, W].
        valid: whether depths are valid [images, H, W].
        points: world points in metres [images, H, W, 3].
        photo: colours [images, 3, H, W].
        share: factors of the opacities [images, H, W]; without rows: 1.
        intrinsics: in pixels [images, 3, 3].
        turns: quaternions from camera axes to the world [images, 4].
        constants: fields of :class:`ghgs_lit.ops.activation.Constants`.
        on_surface: raw values refer to surface axes.
        means: written, in metres [N, 3].
        quaternions: written [N, 4].
        scales: written, in metres [N, 3].
        opacities: written [N].
        colors: written [N, 3].
        image: index of the image.
        first: first Gaussian.
        last: end of the Gaussians, excluded.
    """
    limit, unit, inward, floor, span, across, thickness, least, bias, change = constants
    camera = intrinsics[image]
    width = depth.shape[2]
    values = simd.aligned(LINES * LANES)
    rows = simd.aligned(LANES)
    columns = simd.aligned(LANES)
    focal = np.sqrt(camera[0, 0] * camera[1, 1])
    for start in range(first, last, LANES):
        _read(
            offset, scale, rotation, opacity, color, pixel, depth, valid, points, photo, share, image, start,
            last, values,
        )  # fmt: skip
        own = _line(values, DEPTH)
        footprint = own / focal
        q = _unit(
            _line(values, ROTATION) + ONE, _line(values, ROTATION + 1), _line(values, ROTATION + 2),
            _line(values, ROTATION + 3),
        )  # fmt: skip
        right = _line(values, OFFSET)
        up = _line(values, OFFSET + 1)
        back = _line(values, OFFSET + 2)
        if limit > 0:
            moved = (_tanh(right) * limit, _tanh(up) * limit, _tanh(back) * limit + footprint * inward)
        else:
            moved = (right * unit, up * unit, back * unit + footprint * inward)
        if on_surface:
            for lane in range(LANES):
                place = pixel[min(start + lane, last - 1)]
                rows[lane], columns[lane] = place // width, place % width
            axes = _axes(values, camera, turns[image], memory.load(rows, 0), memory.load(columns, 0), own)
            moved = _rotate(axes, moved)
            q = _multiply(axes, q)
        for k in range(3):
            size = _line(values, SCALE + k) + (thickness if k == 2 else across)
            memory.store(values, (SCALE + k) * LANES, footprint * (floor * _exp(_sigmoid(size) * span)))
            shade = _line(values, PHOTO + k) + _tanh(_line(values, COLOR + k)) * change
            memory.store(values, (COLOR + k) * LANES, shade)
        for k in range(3):
            memory.store(values, (OFFSET + k) * LANES, _line(values, POINT + k) + moved[k])
        for k in range(4):
            memory.store(values, (ROTATION + k) * LANES, q[k])
        shown = _sigmoid(_line(values, OPACITY) + bias) * (ONE - least) + least
        memory.store(values, OPACITY * LANES, shown * _line(values, SHARE))
        for lane in range(min(LANES, last - start)):
            for k in range(3):
                means[start + lane, k] = values[(OFFSET + k) * LANES + lane]
                scales[start + lane, k] = values[(SCALE + k) * LANES + lane]
                colors[start + lane, k] = values[(COLOR + k) * LANES + lane]
            for k in range(4):
                quaternions[start + lane, k] = values[(ROTATION + k) * LANES + lane]
            opacities[start + lane] = values[OPACITY * LANES + lane]


#: Gaussians in one task.
_TASK = 1024


def activate(*inputs: Any) -> tuple[Tensor, ...]:
    """Kernel of the operator of :mod:`ghgs_lit.ops.activation`; image indices must be ascending."""
    *raw, color, image, pixel, depth, valid, points, photo, share = inputs[:12]
    intrinsics, extrinsics, constants, on_surface = inputs[12:]
    color = raw[0].new_empty(0, 3) if color is None else color
    share = raw[0].new_empty(0, *photo.shape[3:]) if share is None else share.flatten(0, 1)
    turns = matrix_to_quaternion(extrinsics.flatten(0, 1)[:, :3, :3].mT)
    tables = (*(x.flatten(0, 1) for x in (depth, valid, points, photo)), share)
    count = len(pixel)
    out = [raw[0].new_empty(count, *size) for size in ((3,), (4,), (3,), (), (3,))]
    read = (*raw, color, pixel, *tables, intrinsics.flatten(0, 1), turns)
    arrays = [x.detach().contiguous().numpy() for x in read]
    numbers = tuple(np.float32(x) for x in constants)
    ends = np.searchsorted(image.numpy(), np.arange(len(turns) + 1)).tolist()
    given = (*arrays, numbers, on_surface, *(x.numpy() for x in out))
    ranges = [(view, *pair) for view, pair in enumerate(pairwise(ends))]
    pool.run_rows(activate_rows(), given, ranges, _TASK, count)
    return tuple(out)
