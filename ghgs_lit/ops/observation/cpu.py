"""The kernel of observations."""

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
    """Coordinate of points along an axis of a camera, in metres.

    Args:
        row: of [R t], of the axis.
        x: coordinates in the world, 16 points, as are the next two.
        y: second coordinates.
        z: third coordinates.
    """
    return row[0] * x + (row[1] * y + (row[2] * z + row[3]))


@helper
def _put_cells(place, side, cells):
    """Write the two cells around positions along an axis and their weights, 0 beyond the border.

    Args:
        place: positions in pixels, with centres at +0.5.
        side: pixels along the axis.
        cells: written: the first cells, the second ones, and the weights of both.
    """
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
    """Bilinear value of a map.

    Args:
        plane: [H, W].
        rows: numbers of two rows.
        columns: numbers of two columns.
        weights: of the four pixels, row by row.
    """
    upper = weights[0] * plane[rows[0], columns[0]] + weights[1] * plane[rows[0], columns[1]]
    return upper + (weights[2] * plane[rows[1], columns[0]] + weights[3] * plane[rows[1], columns[1]])


@helper
def _cells(lane, down, across):
    """Rows, columns and weights of the four pixels around one of 16 points,
    from :func:`_put_cells`."""
    rows = np.uint64(down[lane]), np.uint64(down[LANES + lane])
    columns = np.uint64(across[lane]), np.uint64(across[LANES + lane])
    top = down[2 * LANES + lane]
    bottom = down[3 * LANES + lane]
    left = across[2 * LANES + lane]
    right = across[3 * LANES + lane]
    return rows, columns, (top * left, top * right, bottom * left, bottom * right)


@helper
def _project(camera, pose, x, y, z, height, width, down, across, z_depth):
    """Write the cells around points in a view, and their depths.

    Args:
        camera: intrinsics [3, 3] in pixels.
        pose: extrinsics [4, 4].
        x: coordinates in the world, in metres, 16 points, as are the next two.
        y: second coordinates.
        z: third coordinates.
        height: of the view in pixels.
        width: of the view in pixels.
        down: written, cells along a column, from :func:`_put_cells`.
        across: written, cells along a row.
        z_depth: written, depths in metres.

    Returns:
        The points that the view can see, as bits.
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
        means: [N, 3] in metres.
        colors: [N, 3].
        image: [N], numbers of the images (``b * V + v``) that the Gaussians belong to.
        intrinsics: [B, V, 3, 3] in pixels.
        extrinsics: [B, V, 4, 4].
        photo: [B, V, 3, H, W], photographs.
        mask: [B, V, H, W], share of each pixel that shows the subject.
        drawn: [B, V, 3, H, W], rendered colours.
        alpha: [B, V, 1, H, W], rendered opacities.
        depth: [B, V, 1, H, W], rendered depths in metres.
        near: scale in metres of the distance behind the rendered surface.
        out: [N, V, 11], written in these rows.
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
    # Index of each view among the values of a Gaussian, for each own view.
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
    """The operator of :mod:`ghgs_lit.ops.observation`."""
    *tensors, near, splits = inputs
    means = tensors[0]
    photo = tensors[5]
    out = photo.new_empty(len(means), photo.shape[1], CHANNELS)
    arrays = [x.detach().contiguous().numpy() for x in tensors]
    ranges = pairwise((0, *accumulate(splits)))
    pool.run_rows(observe_rows(), (*arrays, near, out.numpy()), ranges, _TASK, len(means))
    return out
