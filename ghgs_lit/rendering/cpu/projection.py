"""Gaussians to splats: perspective projection of means and covariances, eight at a time, in doubles."""

import math

import numpy as np

from ghgs_lit.rendering.cpu import geometry, layout, simd
from ghgs_lit.rendering.cpu.compile import helper, kernel

_WIDE = simd.DOUBLES
# Pixels beyond which no splat can matter, and up to which float32 counts without overflow.
_FAR = 1e30

# Rows of 8 doubles between the vectors of splats and what is written of each: first the pixels of its
# box, then its record, in the record's order.
_LEFT, _RIGHT, _TOP, _BOTTOM, _RECORD = 0, 1, 2, 3, 4
_ROWS = _RECORD + layout.SLOPE_Y + 1


@kernel
def share(means, quaternions, scales, opacities, first, last, alpha_min, stride, shared):
    """What all views share of Gaussians ``first`` to ``last``, into rows ``stride`` apart; see ``layout``."""
    quaternion, scale = np.empty(4 * _WIDE), np.empty(3 * _WIDE)
    for n in range(first, last, _WIDE):
        geometry.gather(quaternions, n, last, quaternion)
        geometry.gather(scales, n, last, scale)
        w, x, y, z, _ = geometry.unit(quaternion)
        matrix = geometry.rotation(w, x, y, z)
        sx, sy, sz = simd.load(scale, 0), simd.load(scale, _WIDE), simd.load(scale, 2 * _WIDE)
        at = layout.ROOT * stride + n
        # Rows are padded by a vector, and a later chunk overwrites what an earlier one wrote beyond it.
        simd.store(shared, at, matrix[0] * sx)
        simd.store(shared, at + stride, matrix[1] * sy)
        simd.store(shared, at + 2 * stride, matrix[2] * sz)
        simd.store(shared, at + 3 * stride, matrix[3] * sx)
        simd.store(shared, at + 4 * stride, matrix[4] * sy)
        simd.store(shared, at + 5 * stride, matrix[5] * sz)
        simd.store(shared, at + 6 * stride, matrix[6] * sx)
        simd.store(shared, at + 7 * stride, matrix[7] * sy)
        simd.store(shared, at + 8 * stride, matrix[8] * sz)
    for n in range(first, last):
        for k in range(3):
            shared[k * stride + n] = means[n, k]
        opacity = np.float64(opacities[n])
        shared[layout.SHARED_OPACITY * stride + n] = opacity
        shared[layout.SHARED_CUTOFF * stride + n] = math.log2(opacity / alpha_min) if opacity > 0 else -1.0


@helper
def _project_vector(view, shared, stride, n, near, far, low_pass, extent, antialiased, rows):
    """Project Gaussians ``n`` to ``n + 8`` into ``rows``; returns those that touch wanted pixels, as bits."""
    one, half, zero = simd.full(1.0), simd.full(0.5), simd.full(0.0)
    low_pass, limit = simd.full(low_pass), simd.full(_FAR)
    x, y, z, inverse = geometry.camera_points(view, shared, stride, n)
    held_x, held_y = geometry.held(view, x, y)
    m = geometry.footprint(
        geometry.affine(view, held_x, held_y, inverse), geometry.load_root(shared, stride, n)
    )
    bare, determinant, xx, yy = geometry.determinants(m, geometry.normal(m), low_pass)
    b = geometry.dot(m[0], m[1], m[2], m[3], m[4], m[5])
    a, c = xx + low_pass, yy + low_pass
    u = simd.fma(simd.full(view[layout.FX]), x, simd.full(view[layout.CX]))
    v = simd.fma(simd.full(view[layout.FY]), y, simd.full(view[layout.CY]))
    opacity = simd.load(shared, layout.SHARED_OPACITY * stride + n)
    cutoff = simd.load(shared, layout.SHARED_CUTOFF * stride + n)
    if antialiased:
        ratio = simd.minimum(simd.maximum(bare / determinant, zero), one)
        opacity = opacity * simd.root(ratio)
        simd.store(rows, 0, ratio)
        for lane in range(_WIDE):
            rows[lane] = 0.5 * math.log2(rows[lane]) if rows[lane] > 0 else -np.inf
        cutoff = cutoff + simd.load(rows, 0)
    visible = (z >= simd.full(near)) & (z <= simd.full(far)) & (cutoff >= zero)
    visible = visible & (determinant > zero) & (determinant < simd.full(np.inf))
    visible = visible & (u > zero - limit) & (u < limit) & (v > zero - limit) & (v < limit)
    if simd.bits(visible) == 0:
        return 0
    cutoff = simd.minimum(cutoff, simd.full(0.5 * extent * extent * geometry.TO_LOG2))
    reach = simd.full(2.0 / geometry.TO_LOG2) * cutoff
    half_width = simd.minimum(simd.root(reach * a), limit)
    half_height = simd.minimum(simd.root(reach * c), limit)
    # Wanted pixels whose centres lie in the box, clamped before they become integers.
    left = simd.maximum(zero - simd.floor(half - (u - half_width)), simd.full(view[layout.LEFT]))
    right = simd.minimum(simd.floor(u + half_width - half), simd.full(view[layout.RIGHT]))
    top = simd.maximum(zero - simd.floor(half - (v - half_height)), simd.full(view[layout.TOP]))
    bottom = simd.minimum(simd.floor(v + half_height - half), simd.full(view[layout.BOTTOM]))
    visible = visible & (left <= right) & (top <= bottom)
    k_yy = simd.full(geometry.K_SCALE) * simd.root(a / determinant)
    inverse_a = one / a
    simd.store(rows, _LEFT * _WIDE, left)
    simd.store(rows, _RIGHT * _WIDE, right)
    simd.store(rows, _TOP * _WIDE, top)
    simd.store(rows, _BOTTOM * _WIDE, bottom)
    column, row, first = simd.floor(u), simd.floor(v), _RECORD * _WIDE
    simd.store(rows, first + layout.COLUMN * _WIDE, column)
    simd.store(rows, first + layout.ROW * _WIDE, row)
    simd.store(rows, first + layout.REST_X * _WIDE, half - (u - column))
    simd.store(rows, first + layout.REST_Y * _WIDE, half - (v - row))
    simd.store(rows, first + layout.K_XX * _WIDE, simd.full(geometry.K_SCALE) * simd.root(inverse_a))
    simd.store(rows, first + layout.K_YX * _WIDE, zero - k_yy * b * inverse_a)
    simd.store(rows, first + layout.K_YY * _WIDE, k_yy)
    simd.store(rows, first + layout.OPACITY * _WIDE, opacity)
    simd.store(rows, first + layout.CUTOFF * _WIDE, cutoff)
    simd.store(rows, first + layout.DEPTH * _WIDE, z)
    simd.store(rows, first + layout.SLOPE_X * _WIDE, b / c)
    simd.store(rows, first + layout.SLOPE_Y * _WIDE, b * inverse_a)
    return simd.bits(visible)


@kernel
def project(
    view, shared, stride, start, count, shift, near, far, low_pass, extent, antialiased, tiles_x, records,
    depths, rects, tile_counts,
):  # fmt: skip
    """Splats ``start`` to ``start + count`` of one view; returns how many are seen.

    Fills ``records``; ``rects`` [M, 4] with the tiles touched (left, right, top, bottom; empty if unseen);
    ``depths`` with their float32 depth; adds to ``tile_counts`` [tiles] of this view.
    """
    rows = np.empty(_ROWS * _WIDE)
    seen = 0
    for s in range(start, start + count, _WIDE):
        visible = _project_vector(
            view, shared, stride, s + shift, near, far, low_pass, extent, antialiased, rows
        )
        for lane in range(min(_WIDE, start + count - s)):
            m = s + lane
            if not visible >> lane & 1:
                rects[m, 0], rects[m, 1], rects[m, 2], rects[m, 3] = 0, 0, 0, 0
                continue
            seen += 1
            x0, x1 = int(rows[_LEFT * _WIDE + lane]), int(rows[_RIGHT * _WIDE + lane])
            y0, y1 = int(rows[_TOP * _WIDE + lane]), int(rows[_BOTTOM * _WIDE + lane])
            x0, x1 = x0 // layout.TILE, x1 // layout.TILE + 1
            y0, y1 = y0 // layout.TILE, y1 // layout.TILE + 1
            rects[m, 0], rects[m, 1], rects[m, 2], rects[m, 3] = x0, x1, y0, y1
            for y in range(y0, y1):
                for x in range(x0, x1):
                    tile_counts[y * tiles_x + x] += 1
            for k in range(layout.SLOPE_Y + 1):
                records[m, k] = rows[(_RECORD + k) * _WIDE + lane]
            depths[m] = records[m, layout.DEPTH]
    return seen
