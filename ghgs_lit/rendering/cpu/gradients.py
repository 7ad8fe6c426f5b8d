"""From the gradients of entries to those of Gaussians: the projection's derivative, eight at a time.

Sums run in a fixed order (entries of a splat, then views), so results do not depend on threads.
"""

import numpy as np

from ghgs_lit.rendering.cpu import geometry, layout, simd
from ghgs_lit.rendering.cpu.compile import helper, kernel

_WIDE = simd.DOUBLES
# Rows of 8 doubles for each splat: the sums of its entries up to D_DEPTH, then from its record.
_K_XX, _K_YX, _K_YY, _OPACITY, _SEEN = 7, 8, 9, 10, 11
_ROWS = 12
# Rows of 8 doubles for each Gaussian: gradients of its mean, of R S, and of its opacity.
_MEAN, _ROOT, _D_OPACITY = 0, 3, 12
_SUMS = 13

# The K and with them the whitened moments carry a factor K_SCALE each.
_FIRST_MOMENT, _SECOND_MOMENT = geometry.K_SCALE**-2, geometry.K_SCALE**-4


@helper
def _gather_splats(first, count, shift, records, rects, entry_starts, gradients, width, d_colors, line, rows):
    """Sum the entries of the splats of Gaussians ``first`` to ``first + count``; returns whether any is seen.

    Colours are finished here: their gradients are added to ``d_colors``.
    """
    any_seen = False
    for lane in range(_WIDE):
        s = first + lane - shift
        is_seen = lane < count and rects[s, 0] < rects[s, 1]
        rows[_SEEN * _WIDE + lane] = 1.0 if is_seen else 0.0
        if not is_seen:
            continue
        any_seen = True
        for vector in range(0, width, simd.LANES):
            total = simd.full(np.float32(0))
            for entry in range(entry_starts[s], entry_starts[s + 1]):
                total = total + simd.load(gradients, entry * width + vector)
            simd.store(line, vector, total)
        for k in range(layout.D_DEPTH + 1):
            rows[k * _WIDE + lane] = line[k]
        for c in range(d_colors.shape[1]):
            d_colors[first + lane, c] += line[layout.COLOR + c]
        rows[_K_XX * _WIDE + lane] = records[s, layout.K_XX]
        rows[_K_YX * _WIDE + lane] = records[s, layout.K_YX]
        rows[_K_YY * _WIDE + lane] = records[s, layout.K_YY]
        rows[_OPACITY * _WIDE + lane] = records[s, layout.OPACITY]
    return any_seen


@helper
def _row(rows, k):
    return simd.load(rows, k * _WIDE)


@helper
def _add(sums, k, seen, value):
    """Add to a row in the lanes that are seen; what is not finite in others stays there."""
    old = _row(sums, k)
    simd.store(sums, k * _WIDE, simd.select(seen, old + value, old))


@helper
def _footprint_gradient(rows, m, low_pass, antialiased):
    """``dL/dM`` (2 x 3) and ``dL/d opacity``.

    The covariance's gradient is ``G = L^-T H L^-1 / 2`` with the whitened second moments H, and
    ``dL/dM = 2 G M``. Under anti-aliasing opacity carries ``(det before / det after)^(1/2)`` too.
    """
    k_xx, k_yx, k_yy = _row(rows, _K_XX), _row(rows, _K_YX), _row(rows, _K_YY)
    scale = simd.full(_SECOND_MOMENT)
    pp, pq = scale * _row(rows, layout.H_PP), scale * _row(rows, layout.H_PQ)
    qq = scale * _row(rows, layout.H_QQ)
    xx = k_xx * (k_xx * pp + k_yx * pq) + k_yx * (k_xx * pq + k_yx * qq)
    xy, yy = k_yy * (k_xx * pq + k_yx * qq), k_yy * k_yy * qq
    h = _row(rows, layout.H)
    d_opacity = h / _row(rows, _OPACITY)
    out = (
        xx * m[0] + xy * m[3], xx * m[1] + xy * m[4], xx * m[2] + xy * m[5],
        xy * m[0] + yy * m[3], xy * m[1] + yy * m[4], xy * m[2] + yy * m[5],
    )  # fmt: skip
    if antialiased:
        one, low_pass = simd.full(1.0), simd.full(low_pass)
        n = geometry.normal(m)
        bare, determinant, _, _ = geometry.determinants(m, n, low_pass)
        d_opacity = d_opacity * simd.root(bare / determinant)
        # d ln(compensation) = (d ln bare - d ln determinant) / 2, of sums of squares in n and in m.
        d_n, d_m = h * (one / bare - one / determinant), simd.full(0.0) - h * low_pass / determinant
        out = (
            out[0] + d_n * (m[4] * n[2] - m[5] * n[1]) + d_m * m[0],
            out[1] + d_n * (m[5] * n[0] - m[3] * n[2]) + d_m * m[1],
            out[2] + d_n * (m[3] * n[1] - m[4] * n[0]) + d_m * m[2],
            out[3] + d_n * (n[1] * m[2] - n[2] * m[1]) + d_m * m[3],
            out[4] + d_n * (n[2] * m[0] - n[0] * m[2]) + d_m * m[4],
            out[5] + d_n * (n[0] * m[1] - n[1] * m[0]) + d_m * m[5],
        )
    return out, d_opacity


@helper
def _point_gradient(view, x, y, inverse, d_u, d_v, d_z, d_t):
    """``dL/d point`` in camera axes from the centre, the depth and ``J W`` (2 x 3), for x / z and y / z."""
    zero, r = simd.full(0.0), layout.ROTATION
    held_x, held_y = geometry.held(view, x, y)
    fx, fy = simd.full(view[layout.FX]) * inverse, simd.full(view[layout.FY]) * inverse
    # J_xx = fx and J_xz = -fx held_x; dL/dJ = dL/d(J W) W^T.
    a, b, c = simd.full(view[r + 6]), simd.full(view[r + 7]), simd.full(view[r + 8])
    d_xz, d_yz = geometry.dot(d_t[0], d_t[1], d_t[2], a, b, c), geometry.dot(d_t[3], d_t[4], d_t[5], a, b, c)
    d_xx = geometry.dot(
        d_t[0], d_t[1], d_t[2], simd.full(view[r]), simd.full(view[r + 1]), simd.full(view[r + 2])
    )
    d_yy = geometry.dot(
        d_t[3], d_t[4], d_t[5], simd.full(view[r + 3]), simd.full(view[r + 4]), simd.full(view[r + 5])
    )
    d_x = fx * (d_u - inverse * simd.select(held_x == x, d_xz, zero))
    d_y = fy * (d_v - inverse * simd.select(held_y == y, d_yz, zero))
    slope = fx * (d_xx - held_x * d_xz) + fy * (d_yy - held_y * d_yz)
    return d_x, d_y, d_z - x * d_x - y * d_y - inverse * slope


@helper
def _splat_gradients(view, shared, stride, n, rows, low_pass, antialiased, sums):
    """Add eight splats' gradients to those of their Gaussians."""
    seen = _row(rows, _SEEN) > simd.full(0.0)
    x, y, _, inverse = geometry.camera_points(view, shared, stride, n)
    held_x, held_y = geometry.held(view, x, y)
    t, root = geometry.affine(view, held_x, held_y, inverse), geometry.load_root(shared, stride, n)
    d_m, d_opacity = _footprint_gradient(rows, geometry.footprint(t, root), low_pass, antialiased)
    _add(sums, _D_OPACITY, seen, d_opacity)
    for k in range(3):
        _add(sums, _ROOT + k, seen, t[0] * d_m[k] + t[3] * d_m[3 + k])
        _add(sums, _ROOT + 3 + k, seen, t[1] * d_m[k] + t[4] * d_m[3 + k])
        _add(sums, _ROOT + 6 + k, seen, t[2] * d_m[k] + t[5] * d_m[3 + k])
    d_t = (
        geometry.dot(d_m[0], d_m[1], d_m[2], root[0], root[1], root[2]),
        geometry.dot(d_m[0], d_m[1], d_m[2], root[3], root[4], root[5]),
        geometry.dot(d_m[0], d_m[1], d_m[2], root[6], root[7], root[8]),
        geometry.dot(d_m[3], d_m[4], d_m[5], root[0], root[1], root[2]),
        geometry.dot(d_m[3], d_m[4], d_m[5], root[3], root[4], root[5]),
        geometry.dot(d_m[3], d_m[4], d_m[5], root[6], root[7], root[8]),
    )
    # dL / d centre = L^-T (H_P, H_Q).
    scale, h_q = simd.full(_FIRST_MOMENT), _row(rows, layout.H_Q)
    d_u = scale * (_row(rows, _K_XX) * _row(rows, layout.H_P) + _row(rows, _K_YX) * h_q)
    d_v = scale * _row(rows, _K_YY) * h_q
    point = _point_gradient(view, x, y, inverse, d_u, d_v, _row(rows, layout.D_DEPTH), d_t)
    for k in range(3):
        r = layout.ROTATION + k
        a, b, c = simd.full(view[r]), simd.full(view[r + 3]), simd.full(view[r + 6])
        _add(sums, _MEAN + k, seen, geometry.dot(a, b, c, point[0], point[1], point[2]))


@helper
def _shape_gradients(quaternion, scale, sums, d_scale, d_quaternion):
    """Gradients of scales and quaternions from those of ``R S``."""
    w, x, y, z, inverse = geometry.unit(quaternion)
    rotation = geometry.rotation(w, x, y, z)
    d = (
        _row(sums, _ROOT), _row(sums, _ROOT + 1), _row(sums, _ROOT + 2), _row(sums, _ROOT + 3),
        _row(sums, _ROOT + 4), _row(sums, _ROOT + 5), _row(sums, _ROOT + 6), _row(sums, _ROOT + 7),
        _row(sums, _ROOT + 8),
    )  # fmt: skip
    for k in range(3):
        value = geometry.dot(rotation[k], rotation[3 + k], rotation[6 + k], d[k], d[3 + k], d[6 + k])
        simd.store(d_scale, k * _WIDE, value)
    a, b, c = _row(scale, 0), _row(scale, 1), _row(scale, 2)
    d = (d[0] * a, d[1] * b, d[2] * c, d[3] * a, d[4] * b, d[5] * c, d[6] * a, d[7] * b, d[8] * c)
    two = simd.full(2.0)
    d_w = two * (x * (d[7] - d[5]) + y * (d[2] - d[6]) + z * (d[3] - d[1]))
    d_x = two * (y * (d[1] + d[3]) + z * (d[2] + d[6]) + w * (d[7] - d[5]) - two * x * (d[4] + d[8]))
    d_y = two * (x * (d[1] + d[3]) + z * (d[5] + d[7]) + w * (d[2] - d[6]) - two * y * (d[0] + d[8]))
    d_z = two * (x * (d[2] + d[6]) + y * (d[5] + d[7]) + w * (d[3] - d[1]) - two * z * (d[0] + d[4]))
    along = d_w * w + d_x * x + (d_y * y + d_z * z)
    simd.store(d_quaternion, 0, inverse * (d_w - along * w))
    simd.store(d_quaternion, _WIDE, inverse * (d_x - along * x))
    simd.store(d_quaternion, 2 * _WIDE, inverse * (d_y - along * y))
    simd.store(d_quaternion, 3 * _WIDE, inverse * (d_z - along * z))


@helper
def _scatter(rows, first, count, out):
    for lane in range(count):
        for k in range(out.shape[1]):
            out[first + lane, k] = rows[k * _WIDE + lane]


@kernel
def collect(
    quaternions, scales, views, first_view, last_view, first, last, shifts, low_pass, antialiased, shared,
    stride, records, rects, entry_starts, gradients, d_means, d_quaternions, d_scales, d_opacities,
    d_colors,
):  # fmt: skip
    """Gradients of Gaussians ``first`` to ``last``, summed over the views that show them."""
    width = (layout.COLOR + d_colors.shape[1] + simd.LANES - 1) // simd.LANES * simd.LANES
    line = simd.aligned(width)
    rows, sums = np.zeros(_ROWS * _WIDE), np.empty(_SUMS * _WIDE)
    quaternion, scale = np.empty(4 * _WIDE), np.empty(3 * _WIDE)
    d_quaternion, d_scale = np.empty(4 * _WIDE), np.empty(3 * _WIDE)
    for n in range(first, last, _WIDE):
        count = min(_WIDE, last - n)
        sums[:] = 0.0
        any_seen = False
        for v in range(first_view, last_view):
            if _gather_splats(
                n, count, shifts[v], records, rects, entry_starts, gradients, width, d_colors, line, rows
            ):
                any_seen = True
                _splat_gradients(views[v], shared, stride, n, rows, low_pass, antialiased, sums)
        if not any_seen:
            continue
        geometry.gather(quaternions, n, last, quaternion)
        geometry.gather(scales, n, last, scale)
        _shape_gradients(quaternion, scale, sums, d_scale, d_quaternion)
        _scatter(sums, n, count, d_means)
        _scatter(d_quaternion, n, count, d_quaternions)
        _scatter(d_scale, n, count, d_scales)
        for lane in range(count):
            d_opacities[n + lane] = sums[_D_OPACITY * _WIDE + lane]
