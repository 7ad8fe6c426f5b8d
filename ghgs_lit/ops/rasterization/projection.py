"""Perspective projection of Gaussians to splats, eight at a time, in double precision."""

import numpy as np

from ghgs_lit.ops import simd
from ghgs_lit.ops.compile import helper, kernel
from ghgs_lit.ops.rasterization import geometry, layout, tables

_WIDE = simd.DOUBLES
# Splats whose centre is farther away, in pixels, are not rendered: float32 could overflow.
_FAR = 1e30
# Largest rendered depth in metres: practically no limit.
_FARTHEST = 1e10
# Largest p^2 + q^2 that is rendered.
_LARGEST = 0.5 * layout.EXTENT * layout.EXTENT * geometry.TO_LOG2


@helper
def _extents(view, u, v, a, c, cutoff):
    """First and last pixels, across and down, whose centres lie in the bounding boxes of splats.

    Args:
        view: a camera, [VIEW].
        u: column of the splat's centre, in pixels.
        v: row of the splat's centre, in pixels.
        a: variance across in px^2, low-pass included.
        c: variance down in px^2, low-pass included.
        cutoff: largest p^2 + q^2 that is rendered.

    Returns:
        Left, right, top and bottom.
    """
    reach = (2.0 / geometry.TO_LOG2) * cutoff
    half_width = simd.minimum(simd.sqrt(reach * a), _FAR)
    half_height = simd.minimum(simd.sqrt(reach * c), _FAR)
    left = simd.maximum(0.0 - simd.floor(0.5 - (u - half_width)), 0.0)
    right = simd.minimum(simd.floor(u + half_width - 0.5), view[layout.RIGHT])
    top = simd.maximum(0.0 - simd.floor(0.5 - (v - half_height)), 0.0)
    bottom = simd.minimum(simd.floor(v + half_height - 0.5), view[layout.BOTTOM])
    return left, right, top, bottom


@helper
def _project_vector(
    view, mean, root, opacity, near, low_pass, antialiased, m, records, depths, boxes
):  # fmt: skip
    """Project eight Gaussians to splats ``m`` to ``m + 8``.

    Args:
        view: a camera, [VIEW].
        mean: x, y and z in metres.
        root: ``R S``, 3 x 3.
        opacity: opacities of the Gaussians.
        near: smallest rendered depth, in metres.
        low_pass: added variance in px^2.
        antialiased: scale opacity by the determinants.
        m: first splat.
        records: written, [splats, RECORD].
        depths: written, z in metres, [splats, 1].
        boxes: written, the tiles that each splat touches, int32 [splats, 4]; empty if it is not
            visible.

    Returns:
        Bit mask of the visible splats.
    """
    x, y, z, inverse = geometry.camera_points(view, mean)
    clamped_x, clamped_y = geometry.clamp_to_frame(view, x, y)
    footprint = geometry.footprint(geometry.affine(view, clamped_x, clamped_y, inverse), root)
    bare, determinant, xx, yy = geometry.determinants(footprint, geometry.normal(footprint), low_pass)
    a = xx + low_pass
    c = yy + low_pass
    b = geometry.dot(footprint[0], footprint[1], footprint[2], footprint[3], footprint[4], footprint[5])
    u = simd.fma(x, view[layout.FX], view[layout.CX])
    v = simd.fma(y, view[layout.FY], view[layout.CY])
    if antialiased:
        opacity = opacity * simd.sqrt(simd.minimum(simd.maximum(bare / determinant, 0.0), 1.0))
    visible = (z >= near) & (z <= _FARTHEST) & (opacity >= layout.ALPHA_MIN)
    visible = visible & (determinant > 0.0) & (determinant < np.inf)
    visible = visible & (u > -_FAR) & (u < _FAR) & (v > -_FAR) & (v < _FAR)
    # The largest p^2 + q^2 (a power of 2) at which alpha is at least ALPHA_MIN.
    cutoff = simd.maximum(simd.log2(opacity / layout.ALPHA_MIN), 0.0)
    cutoff = simd.minimum(cutoff, _LARGEST)
    left, right, top, bottom = _extents(view, u, v, a, c, cutoff)
    visible = visible & (left <= right) & (top <= bottom)
    seen = simd.bits(visible)
    tile = 1.0 / layout.TILE
    zero = simd.full(0.0)
    tables.store_boxes(boxes, m, (
        simd.select(visible, simd.floor(left * tile), zero),
        simd.select(visible, simd.floor(right * tile) + 1.0, zero),
        simd.select(visible, simd.floor(top * tile), zero),
        simd.select(visible, simd.floor(bottom * tile) + 1.0, zero),
    ))  # fmt: skip
    if seen == 0:
        return seen
    column = simd.floor(u)
    row = simd.floor(v)
    inverse_a = 1.0 / a
    k_yy = geometry.K_SCALE * simd.sqrt(a / determinant)
    tables.store_columns1(depths, m, m + _WIDE, (z,))
    tables.store_lines(records, m, (
        column, row, 0.5 - (u - column), 0.5 - (v - row),
        geometry.K_SCALE * simd.sqrt(inverse_a), 0.0 - k_yy * b * inverse_a, k_yy,
        opacity, cutoff, z, b / c, b * inverse_a,
    ))  # fmt: skip
    return seen


@kernel
def project(
    means, quaternions, scales, opacities, colors, first, last, views, shifts, low_pass, antialiased, near,
    tiles_x, records, depths, boxes, tile_counts,
):  # fmt: skip
    """Project Gaussians ``first`` to ``last`` into all ``views``.

    Args:
        means: in metres, [N, 3].
        quaternions: wxyz of any length, [N, 4].
        scales: in metres, [N, 3].
        opacities: [N, 1].
        colors: [N, 3].
        first: first Gaussian of the part.
        last: end of the part, excluded.
        views: cameras of the part's batch element, float64 [T, VIEW].
        shifts: splat index minus Gaussian index in each of these views, int64 [T].
        low_pass: added variance in px^2.
        antialiased: scale opacities by the determinants.
        near: smallest rendered depth, in metres.
        tiles_x: number of tiles across a view.
        records: written, [splats, RECORD].
        depths: written, z in metres, [splats, 1].
        boxes: written, the tiles that each splat touches, int32 [splats, 4].
        tile_counts: incremented, the part's entries in each tile, int64 [T, tiles].
    """
    for n in range(first, last, _WIDE):
        mean = tables.columns3(means, n, last)
        quaternion = tables.columns4(quaternions, n, last)
        scale = tables.columns3(scales, n, last)
        opacity = tables.columns1(opacities, n, last)
        w, x, y, z, _ = geometry.unit(quaternion)
        root = geometry.scale_columns(geometry.rotation(w, x, y, z), scale)
        for t in range(len(views)):
            m = n + shifts[t]
            seen = _project_vector(
                views[t], mean, root, opacity[0], near, low_pass, antialiased, m, records, depths, boxes
            )
            while seen != 0:
                s = m + simd.trailing_zeros(seen)
                seen &= seen - 1
                for c in range(layout.CHANNELS):
                    records[s, layout.COLORS + c] = colors[s - shifts[t], c]
                for tile_y in range(boxes[s, layout.Y0], boxes[s, layout.Y1]):
                    for tile_x in range(boxes[s, layout.X0], boxes[s, layout.X1]):
                        tile_counts[t, tile_y * tiles_x + tile_x] += 1
