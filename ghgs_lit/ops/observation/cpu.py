"""CPU kernel of the observations of Gaussians."""

from itertools import accumulate, pairwise
from typing import Any

import numpy as np
from numba.core import types
from torch import Tensor

from ghgs_lit.ops import memory, pool, simd
from ghgs_lit.ops.compile import FLOATS, NUMBER, helper, kernel_for
from ghgs_lit.ops.simd import LANES

ZERO = np.float32(0)
HALF = np.float32(0.5)
ONE = np.float32(1)
CHANNELS = 11

_SEEN = (FLOATS[2], FLOATS[2], types.Array(types.int64, 1, "C"), FLOATS[4], FLOATS[4])
_MAPS = (FLOATS[5], FLOATS[4], FLOATS[5], FLOATS[5], FLOATS[5])


@helper
def _axis(row, x, y, z):
    """Coordinates of 16 world points along the camera axis given by a row of [R t], in metres."""
    return row[0] * x + (row[1] * y + (row[2] * z + row[3]))


@helper
def _put_cells(place, side, cells):
    """Write the first and second cells around positions along an axis, in pixels with centres at +0.5, and
    their weights, which are 0 outside."""
    place = place - HALF
    first = simd.floor(place)
    share = place - first
    last = np.float32(side - 1)
    memory.store(cells, 0, simd.maximum(first, ZERO))
    memory.store(cells, LANES, simd.minimum(first + ONE, last))
    memory.store(cells, 2 * LANES, simd.select(first >= ZERO, ONE - share, ZERO))
    memory.store(cells, 3 * LANES, simd.select(first < last, share, ZERO))


@helper
def _between(plane, rows, columns, weights):
    """Bilinear value of a map [H, W], from two rows, two columns and four weights, row by row."""
    upper = weights[0] * plane[rows[0], columns[0]] + weights[1] * plane[rows[0], columns[1]]
    return upper + (weights[2] * plane[rows[1], columns[0]] + weights[3] * plane[rows[1], columns[1]])


@helper
def _cells(lane, down, across):
    """Rows, columns and weights of the four pixels around one of 16 points; see :func:`_put_cells`."""
    rows = np.uint64(down[lane]), np.uint64(down[LANES + lane])
    columns = np.uint64(across[lane]), np.uint64(across[LANES + lane])
    top = down[2 * LANES + lane]
    bottom = down[3 * LANES + lane]
    left = across[2 * LANES + lane]
    right = across[3 * LANES + lane]
    return rows, columns, (top * left, top * right, bottom * left, bottom * right)


@helper
def _project(camera, pose, x, y, z, height, width, down, across, z_depth):
    """Project 16 points into a view: write the cells around them and their depths.

    Args:
        camera: intrinsics [3, 3] in pixels.
        pose: extrinsics [4, 4].
        x: world coordinates in metres.
        y: world coordinates in metres.
        z: world coordinates in metres.
        height: height of the view in pixels.
        width: width of the view in pixels.
        down: written, cells along a column; see :func:`_put_cells`.
        across: written, cells along a row.
        z_depth: written, depths in metres.

    Returns:
        Bit mask of the points that are in front of the camera and inside the frame.
    """
    distance = _axis(pose[2], x, y, z)
    inverse = ONE / distance
    right = _axis(pose[0], x, y, z) * inverse
    below = _axis(pose[1], x, y, z) * inverse
    u = camera[0, 0] * right + (camera[0, 1] * below + camera[0, 2])
    v = camera[1, 1] * below + camera[1, 2]
    seen = (distance > ZERO) & (u >= ZERO) & (u <= np.float32(width))
    _put_cells(u, width, across)
    _put_cells(v, height, down)
    memory.store(z_depth, 0, distance)
    return simd.bits(seen & (v >= ZERO) & (v <= np.float32(height)))


@kernel_for(*_SEEN, *_MAPS, types.float32, FLOATS[3], NUMBER, NUMBER)
def observe_rows(
    means, colors, image, intrinsics, extrinsics, photo, mask, drawn, alpha, depth, near, out, first, last
):
    """Write rows of the observations of one element; see :func:`observe`.

    Args:
        means: in metres [N, 3].
        colors: [N, 3].
        image: index of each Gaussian's image (``b * V + v``) [N].
        intrinsics: in pixels [B, V, 3, 3].
        extrinsics: world to camera [B, V, 4, 4].
        photo: input views [B, V, 3, H, W].
        mask: coverage of each pixel by the subject [B, V, H, W].
        drawn: rendered colours [B, V, 3, H, W].
        alpha: rendered opacities [B, V, 1, H, W].
        depth: rendered depths in metres [B, V, 1, H, W].
        near: scale of the distance behind the rendered surface, in metres.
        out: written in these rows [N, V, 11].
        first: first row.
        last: end of the rows, excluded.
    """
    views = photo.shape[1]
    height = photo.shape[3]
    width = photo.shape[4]
    element = image[first] // views
    point = simd.aligned(3 * LANES)
    z_depth = simd.aligned(LANES)
    behind = simd.aligned(LANES)
    down = simd.aligned(4 * LANES)
    across = simd.aligned(4 * LANES)
    # Position of each view in the output of a Gaussian, for each own view.
    places = np.empty((views, views), np.int64)
    for own in range(views):
        for view in range(views):
            places[own, view] = (view - own) % views
    for start in range(first, last, LANES):
        count = min(LANES, last - start)
        for lane in range(LANES):
            for axis in range(3):
                point[axis * LANES + lane] = means[start + min(lane, count - 1), axis]
        x = memory.load(point, 0)
        y = memory.load(point, LANES)
        z = memory.load(point, 2 * LANES)
        for view in range(views):
            pose = extrinsics[element, view]
            seen = _project(intrinsics[element, view], pose, x, y, z, height, width, down, across, z_depth)
            behind[:] = ZERO
            for lane in range(count):
                values = out[start + lane, places[image[start + lane] - element * views, view]]
                values[:] = ZERO
                if not seen >> lane & 1:
                    continue
                rows, columns, weights = _cells(lane, down, across)
                for k in range(3):
                    color = _between(photo[element, view, k], rows, columns, weights)
                    values[k] = color - colors[start + lane, k]
                    values[3 + k] = color - _between(drawn[element, view, k], rows, columns, weights)
                values[6] = _between(mask[element, view], rows, columns, weights)
                values[7] = _between(alpha[element, view, 0], rows, columns, weights)
                surface = _between(depth[element, view, 0], rows, columns, weights)
                behind[lane] = (z_depth[lane] - surface) / near
                values[9] = ONE
            memory.store(behind, 0, simd.tanh(memory.load(behind, 0)))
            for lane in range(count):
                own = image[start + lane] - element * views
                values = out[start + lane, places[own, view]]
                values[8] = behind[lane]
                values[10] = ONE if own == view else ZERO


#: Gaussians in one task.
_TASK = 1024


def observe(*inputs: Any) -> Tensor:
    """Kernel of the operator of :mod:`ghgs_lit.ops.observation`."""
    *tensors, near, splits = inputs
    means = tensors[0]
    photo = tensors[5]
    out = photo.new_empty(len(means), photo.shape[1], CHANNELS)
    arrays = [x.detach().contiguous().numpy() for x in tensors]
    ranges = pairwise((0, *accumulate(splits)))
    pool.run_rows(observe_rows(), (*arrays, near, out.numpy()), ranges, _TASK, len(means))
    return out
