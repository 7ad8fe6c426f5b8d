"""Gradients of Gaussians from gradients of entries: the derivative of the projection, eight at a time.

Sums have a fixed order (entries of a splat, then views), so that results do not depend on threads."""

import numpy as np

from ghgs_lit.ops import memory, simd
from ghgs_lit.ops.compile import helper, kernel
from ghgs_lit.ops.rasterization import geometry, layout, tables

_WIDE = simd.DOUBLES
# Rows of 8 doubles: gradients of the mean, of R S, and of the opacity.
_MEAN = 0
_ROOT = 3
_OPACITY = 12
_SUMS = 13

# Each K, and therefore each whitened coordinate, contains a factor K_SCALE.
_FIRST_MOMENT = geometry.K_SCALE**-2
_SECOND_MOMENT = geometry.K_SCALE**-4


@helper
def _gather_splats(m, boxes, entry_starts, reached, gradients, lines):
    """Sum the entries of splats ``m`` to ``m + 8``.

    Args:
        m: first splat.
        boxes: tiles that a splat touches, int32 [splats, 4].
        entry_starts: first slot of each splat, int32 [splats].
        reached: whether an entry was rendered, by slot, uint8 [entries].
        gradients: gradients of entries, by slot, flat [slots x GRADIENT].
        lines: written, the sums of each splat, [8 GRADIENT].

    Returns:
        Bit mask of the rendered splats.
    """
    drawn = 0
    for lane in range(_WIDE):
        s = m + lane
        tiles = (boxes[s, layout.X1] - boxes[s, layout.X0]) * (boxes[s, layout.Y1] - boxes[s, layout.Y0])
        total = simd.full(np.float32(0))
        for slot in range(entry_starts[s], entry_starts[s] + tiles):
            if reached[slot]:
                total = total + memory.load(gradients, slot * layout.GRADIENT)
                drawn |= 1 << lane
        memory.store(lines, lane * layout.GRADIENT, total)
    return drawn


@helper
def _footprint_gradient(moments, record, m, low_pass, antialiased):
    """``dL/dM`` (2 x 3) and ``dL/d opacity`` of eight splats.

    The gradient of the covariance is ``G = L^-T H L^-1 / 2`` with the whitened second moments H, and
    ``dL/dM = 2 G M``. With anti-aliasing, opacity also contains ``(det before / det after)^(1/2)``.

    Args:
        moments: summed gradients of entries (see ``layout``), a tuple of vectors.
        record: records of the splats (see ``layout``), a tuple of vectors.
        m: 2 x 3, from :func:`geometry.footprint`.
        low_pass: added variance in px^2.
        antialiased: whether opacity was scaled by the determinants.
    """
    k_xx = record[layout.K_XX]
    k_yx = record[layout.K_YX]
    k_yy = record[layout.K_YY]
    pp = _SECOND_MOMENT * moments[layout.H_PP]
    pq = _SECOND_MOMENT * moments[layout.H_PQ]
    qq = _SECOND_MOMENT * moments[layout.H_QQ]
    xx = k_xx * (k_xx * pp + k_yx * pq) + k_yx * (k_xx * pq + k_yx * qq)
    xy = k_yy * (k_xx * pq + k_yx * qq)
    yy = k_yy * k_yy * qq
    h = moments[layout.H]
    d_opacity = h / record[layout.OPACITY]
    out = (
        xx * m[0] + xy * m[3], xx * m[1] + xy * m[4], xx * m[2] + xy * m[5],
        xy * m[0] + yy * m[3], xy * m[1] + yy * m[4], xy * m[2] + yy * m[5],
    )  # fmt: skip
    if antialiased:
        n = geometry.normal(m)
        bare, determinant, _, _ = geometry.determinants(m, n, low_pass)
        d_opacity = d_opacity * simd.sqrt(bare / determinant)
        # d ln(compensation) = (d ln bare - d ln determinant) / 2, both sums of squares of n and m.
        d_n = h * (1.0 / bare - 1.0 / determinant)
        d_m = 0.0 - h * low_pass / determinant
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
def _point_gradient(view, x, y, clamped_x, clamped_y, inverse, d_u, d_v, d_z, d_t):
    """``dL/d point`` in camera axes.

    Args:
        view: a camera, [VIEW].
        x: x / z of the point.
        y: y / z of the point.
        clamped_x: x / z at which the Jacobian was evaluated.
        clamped_y: y / z at which the Jacobian was evaluated.
        inverse: 1 / z.
        d_u: gradient of the centre's column.
        d_v: gradient of the centre's row.
        d_z: gradient of the depth.
        d_t: gradient of ``J W``, 2 x 3.
    """
    r = layout.ROTATION
    fx = view[layout.FX] * inverse
    fy = view[layout.FY] * inverse
    # J_xx = fx and J_xz = -fx clamped_x; dL/dJ = dL/d(J W) W^T.
    d_xz = geometry.dot(view[r + 6], view[r + 7], view[r + 8], d_t[0], d_t[1], d_t[2])
    d_yz = geometry.dot(view[r + 6], view[r + 7], view[r + 8], d_t[3], d_t[4], d_t[5])
    d_xx = geometry.dot(view[r], view[r + 1], view[r + 2], d_t[0], d_t[1], d_t[2])
    d_yy = geometry.dot(view[r + 3], view[r + 4], view[r + 5], d_t[3], d_t[4], d_t[5])
    d_x = fx * (d_u - inverse * simd.select(clamped_x == x, d_xz, 0.0))
    d_y = fy * (d_v - inverse * simd.select(clamped_y == y, d_yz, 0.0))
    slope = fx * (d_xx - clamped_x * d_xz) + fy * (d_yy - clamped_y * d_yz)
    return d_x, d_y, d_z - x * d_x - y * d_y - inverse * slope


@helper
def _add(sums, k, drawn, value):
    """Add eight doubles to row ``k`` of ``sums`` in the lanes of ``drawn`` only, since values in others
    may not be finite."""
    old = memory.load(sums, k * _WIDE)
    memory.store(sums, k * _WIDE, simd.select(drawn, old + value, old))


@helper
def _splat_gradients(view, mean, root, moments, record, drawn, low_pass, antialiased, sums):
    """Add the gradients of eight splats of one view to those of their Gaussians.

    Args:
        view: a camera, [VIEW].
        mean: x, y and z in metres.
        root: ``R S``, 3 x 3.
        moments: summed gradients of entries (see ``layout``).
        record: records of the splats (see ``layout``).
        drawn: mask of the rendered splats, eight lanes.
        low_pass: added variance in px^2.
        antialiased: whether opacity was scaled by the determinants.
        sums: accumulated, rows of 8 doubles: gradients of the mean, of ``R S`` and of the opacity.
    """
    x, y, _, inverse = geometry.camera_points(view, mean)
    clamped_x, clamped_y = geometry.clamp_to_frame(view, x, y)
    t = geometry.affine(view, clamped_x, clamped_y, inverse)
    d_m, d_opacity = _footprint_gradient(moments, record, geometry.footprint(t, root), low_pass, antialiased)
    _add(sums, _OPACITY, drawn, d_opacity)
    for k in range(3):
        _add(sums, _ROOT + k, drawn, t[0] * d_m[k] + t[3] * d_m[3 + k])
        _add(sums, _ROOT + 3 + k, drawn, t[1] * d_m[k] + t[4] * d_m[3 + k])
        _add(sums, _ROOT + 6 + k, drawn, t[2] * d_m[k] + t[5] * d_m[3 + k])
    d_t = (
        geometry.dot(d_m[0], d_m[1], d_m[2], root[0], root[1], root[2]),
        geometry.dot(d_m[0], d_m[1], d_m[2], root[3], root[4], root[5]),
        geometry.dot(d_m[0], d_m[1], d_m[2], root[6], root[7], root[8]),
        geometry.dot(d_m[3], d_m[4], d_m[5], root[0], root[1], root[2]),
        geometry.dot(d_m[3], d_m[4], d_m[5], root[3], root[4], root[5]),
        geometry.dot(d_m[3], d_m[4], d_m[5], root[6], root[7], root[8]),
    )
    # dL / d centre = L^-T (H_P, H_Q).
    h_p = _FIRST_MOMENT * moments[layout.H_P]
    h_q = _FIRST_MOMENT * moments[layout.H_Q]
    d_u = record[layout.K_XX] * h_p + record[layout.K_YX] * h_q
    d_v = record[layout.K_YY] * h_q
    d_z = moments[layout.D_DEPTH]
    point = _point_gradient(view, x, y, clamped_x, clamped_y, inverse, d_u, d_v, d_z, d_t)
    for k in range(3):
        r = layout.ROTATION + k
        _add(
            sums, _MEAN + k, drawn,
            geometry.dot(view[r], view[r + 3], view[r + 6], point[0], point[1], point[2]),
        )  # fmt: skip


@helper
def _root_rows(sums):
    """Load the gradient of ``R S`` from its rows of ``sums`` as a 3 x 3 matrix."""
    at = _ROOT * _WIDE
    return (
        memory.load(sums, at), memory.load(sums, at + 8), memory.load(sums, at + 16),
        memory.load(sums, at + 24), memory.load(sums, at + 32), memory.load(sums, at + 40),
        memory.load(sums, at + 48), memory.load(sums, at + 56), memory.load(sums, at + 64),
    )  # fmt: skip


@helper
def _quaternion_gradient(w, x, y, z, inverse, d):
    """Gradient of a quaternion of norm ``1 / inverse``, orthogonal to it, from the unit quaternion and
    the gradient ``d`` (3 x 3) of its rotation matrix."""
    d_w = 2.0 * (x * (d[7] - d[5]) + y * (d[2] - d[6]) + z * (d[3] - d[1]))
    d_x = 2.0 * (y * (d[1] + d[3]) + z * (d[2] + d[6]) + w * (d[7] - d[5]) - 2.0 * x * (d[4] + d[8]))
    d_y = 2.0 * (x * (d[1] + d[3]) + z * (d[5] + d[7]) + w * (d[2] - d[6]) - 2.0 * y * (d[0] + d[8]))
    d_z = 2.0 * (x * (d[2] + d[6]) + y * (d[5] + d[7]) + w * (d[3] - d[1]) - 2.0 * z * (d[0] + d[4]))
    along = d_w * w + d_x * x + (d_y * y + d_z * z)
    return (
        inverse * (d_w - along * w), inverse * (d_x - along * x), inverse * (d_y - along * y),
        inverse * (d_z - along * z),
    )  # fmt: skip


@kernel
def collect(
    means, quaternions, scales, first, last, views, shifts, low_pass, antialiased, records, boxes,
    entry_starts, reached, gradients, d_means, d_quaternions, d_scales, d_opacities, d_colors,
):  # fmt: skip
    """Write the gradients of Gaussians ``first`` to ``last``, summed over ``views``.

    Args:
        means: in metres, [N, 3].
        quaternions: wxyz of any length, [N, 4].
        scales: in metres, [N, 3].
        first: first Gaussian of the part.
        last: end of the part, excluded.
        views: cameras of the part's batch element, float64 [T, VIEW].
        shifts: splat index minus Gaussian index in each of these views, int64 [T].
        low_pass: added variance in px^2.
        antialiased: whether opacity was scaled by the determinants.
        records: [splats, RECORD].
        boxes: tiles that a splat touches, int32 [splats, 4].
        entry_starts: first slot of each splat, int32 [splats].
        reached: whether an entry was rendered, by slot, uint8 [entries].
        gradients: gradients of entries, by slot, from ``backward``.
        d_means: written, [N, 3].
        d_quaternions: written, [N, 4].
        d_scales: written, [N, 3].
        d_opacities: written, [N, 1].
        d_colors: written, [N, 3].
    """
    lines = simd.aligned(_WIDE * layout.GRADIENT)
    sums = np.empty(_SUMS * _WIDE)
    for n in range(first, last, _WIDE):
        mean = tables.columns3(means, n, last)
        scale = tables.columns3(scales, n, last)
        w, x, y, z, inverse = geometry.unit(tables.columns4(quaternions, n, last))
        rotation = geometry.rotation(w, x, y, z)
        root = geometry.scale_columns(rotation, scale)
        sums[:] = 0.0
        d_colors[n : min(n + _WIDE, last)] = np.float32(0)
        for t in range(len(views)):
            m = n + shifts[t]
            drawn = _gather_splats(m, boxes, entry_starts, reached, gradients, lines)
            if drawn == 0:
                continue
            moments = tables.load_lines(lines, 0)
            record = tables.load_lines(records, m)
            _splat_gradients(
                views[t], mean, root, moments, record, simd.mask(drawn), low_pass, antialiased, sums
            )
            while drawn != 0:
                lane = simd.trailing_zeros(drawn)
                drawn &= drawn - 1
                for c in range(layout.CHANNELS):
                    d_colors[n + lane, c] += lines[lane * layout.GRADIENT + layout.COLOR + c]
        d = _root_rows(sums)
        r = rotation
        tables.store_columns3(d_scales, n, last, (
            geometry.dot(r[0], r[3], r[6], d[0], d[3], d[6]),
            geometry.dot(r[1], r[4], r[7], d[1], d[4], d[7]),
            geometry.dot(r[2], r[5], r[8], d[2], d[5], d[8]),
        ))  # fmt: skip
        d_quaternion = _quaternion_gradient(w, x, y, z, inverse, geometry.scale_columns(d, scale))
        tables.store_columns4(d_quaternions, n, last, d_quaternion)
        tables.store_columns3(
            d_means, n, last, (memory.load(sums, 0), memory.load(sums, _WIDE), memory.load(sums, 2 * _WIDE))
        )
        tables.store_columns1(d_opacities, n, last, (memory.load(sums, _OPACITY * _WIDE),))
