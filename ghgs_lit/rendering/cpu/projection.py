"""Gaussians to splats and back: perspective projection of means and covariances, in double precision.

Double precision costs little here (once a splat, not once a pixel) and leaves no finite float32 input
that overflows. With ``M = J W R(q) S`` (2 x 3) the covariance is ``M M^T + low_pass I`` and its
determinant ``|m_0 x m_1|^2 + low_pass tr(M M^T) + low_pass^2``: no subtraction, so no cancellation on
long thin splats.
"""

import math

import numpy as np

from ghgs_lit.rendering.cpu import layout
from ghgs_lit.rendering.cpu.compile import helper, kernel

# p^2 + q^2 = sigma / ln 2, where sigma is the exponent of the Gaussian.
_TO_LOG2 = 1.0 / math.log(2.0)
_ROOT = math.sqrt(0.5 * _TO_LOG2)
# Pixels beyond which no splat can matter, and up to which float32 counts without overflow.
_FAR = 1e30


@helper
def _rotation(quaternion, out):
    """Rotation matrix of a quaternion of any norm into ``out``; identity for the zero quaternion."""
    w, x = np.float64(quaternion[0]), np.float64(quaternion[1])
    y, z = np.float64(quaternion[2]), np.float64(quaternion[3])
    norm = math.sqrt(w * w + x * x + y * y + z * z)
    if norm == 0:
        w = norm = 1.0
    w, x, y, z = w / norm, x / norm, y / norm, z / norm
    out[0], out[1], out[2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    out[3], out[4], out[5] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    out[6], out[7], out[8] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)


@helper
def _camera_point(view, mean, out):
    for i in range(3):
        out[i] = view[layout.TRANSLATION + i]
        for j in range(3):
            out[i] += view[layout.ROTATION + 3 * i + j] * mean[j]


@helper
def _affine(view, point, out):
    """``J W``: the local affine map of the projection, 2 x 3, with x/z and y/z held near the frame."""
    inverse = 1.0 / point[2]
    x = min(max(point[0] * inverse, view[layout.X_LOW]), view[layout.X_HIGH])
    y = min(max(point[1] * inverse, view[layout.Y_LOW]), view[layout.Y_HIGH])
    for j in range(3):
        depth = view[layout.ROTATION + 6 + j]
        out[j] = view[layout.FX] * inverse * (view[layout.ROTATION + j] - x * depth)
        out[3 + j] = view[layout.FY] * inverse * (view[layout.ROTATION + 3 + j] - y * depth)


@kernel
def roots(quaternions, scales, first, last, out):
    """``R(q) S`` of Gaussians ``first`` to ``last`` into ``out`` [N, 9]: what all views share."""
    rotation = np.empty(9)
    for n in range(first, last):
        _rotation(quaternions[n], rotation)
        for i in range(9):
            out[n, i] = rotation[i] * scales[n, i % 3]


@kernel
def project(
    means,
    root,
    opacities,
    view,
    start,
    count,
    shift,
    near,
    far,
    low_pass,
    alpha_min,
    extent,
    antialiased,
    height,
    width,
    records,
    depths,
    rects,
    tile_counts,
):
    """Splats ``start`` to ``start + count`` of one view; returns how many are seen.

    Fills ``records``; ``rects`` [M, 4] with the tiles touched (left, right, top, bottom; empty if unseen);
    ``depths`` with their float32 depth; adds to ``tile_counts`` [tiles] of this view.
    """
    tiles_x = (width + layout.TILE - 1) // layout.TILE
    point, affine, m = np.empty(3), np.empty(6), np.empty(6)
    seen = 0
    most = 0.5 * extent * extent * _TO_LOG2
    for s in range(start, start + count):
        n = s + shift
        rects[s, 0], rects[s, 1], rects[s, 2], rects[s, 3] = 0, 0, 0, 0
        _camera_point(view, means[n], point)
        z = point[2]
        opacity = np.float64(opacities[n])
        if not (z >= near and z <= far and opacity >= alpha_min):
            continue
        _affine(view, point, affine)
        for i in range(2):
            for j in range(3):
                m[3 * i + j] = (
                    affine[3 * i] * root[n, j]
                    + affine[3 * i + 1] * root[n, 3 + j]
                    + affine[3 * i + 2] * root[n, 6 + j]
                )
        a = m[0] * m[0] + m[1] * m[1] + m[2] * m[2]
        b = m[0] * m[3] + m[1] * m[4] + m[2] * m[5]
        c = m[3] * m[3] + m[4] * m[4] + m[5] * m[5]
        nx, ny, nz = m[1] * m[5] - m[2] * m[4], m[2] * m[3] - m[0] * m[5], m[0] * m[4] - m[1] * m[3]
        bare = nx * nx + ny * ny + nz * nz
        determinant = bare + low_pass * (a + c) + low_pass * low_pass
        a, c = a + low_pass, c + low_pass
        u = view[layout.FX] * point[0] / z + view[layout.CX]
        v = view[layout.FY] * point[1] / z + view[layout.CY]
        if not (determinant > 0 and determinant < np.inf and abs(u) < _FAR and abs(v) < _FAR):
            continue
        if antialiased:
            opacity *= math.sqrt(bare / determinant)
            if not opacity >= alpha_min:
                continue
        cutoff = min(math.log2(opacity / alpha_min), most)
        reach = math.sqrt(2.0 * cutoff / _TO_LOG2)
        half_width, half_height = min(reach * math.sqrt(a), _FAR), min(reach * math.sqrt(c), _FAR)
        # Pixels whose centres lie in the box; in floating point until clamped, so nothing overflows.
        left, right = np.ceil(u - half_width - 0.5), np.floor(u + half_width - 0.5)
        top, bottom = np.ceil(v - half_height - 0.5), np.floor(v + half_height - 0.5)
        left, right = max(left, 0.0), min(right, width - 1.0)
        top, bottom = max(top, 0.0), min(bottom, height - 1.0)
        if not (left <= right and top <= bottom):
            continue
        x0, x1 = int(left) // layout.TILE, int(right) // layout.TILE + 1
        y0, y1 = int(top) // layout.TILE, int(bottom) // layout.TILE + 1
        rects[s, 0], rects[s, 1], rects[s, 2], rects[s, 3] = x0, x1, y0, y1
        for y in range(y0, y1):
            for x in range(x0, x1):
                tile_counts[y * tiles_x + x] += 1
        seen += 1
        column, row = np.floor(u), np.floor(v)
        k_yy = _ROOT * math.sqrt(a / determinant)
        records[s, layout.COLUMN], records[s, layout.ROW] = column, row
        records[s, layout.REST_X], records[s, layout.REST_Y] = 0.5 - (u - column), 0.5 - (v - row)
        records[s, layout.K_XX] = _ROOT / math.sqrt(a)
        records[s, layout.K_YX] = -k_yy * b / a
        records[s, layout.K_YY] = k_yy
        records[s, layout.OPACITY] = opacity
        records[s, layout.CUTOFF] = cutoff
        records[s, layout.DEPTH] = z
        records[s, layout.HALF_WIDTH], records[s, layout.HALF_HEIGHT] = half_width, half_height
        depths[s] = z
    return seen


@helper
def _entry_sum(gradients, first, last, out):
    """Add the gradients of a splat's entries in their order: the same sum with any number of threads."""
    out[:] = 0.0
    for entry in range(first, last):
        for k in range(out.shape[0]):
            out[k] += gradients[entry, k]


@helper
def _covariance_gradient(record, total, out):
    """``dL/dSigma`` (xx, xy, yy) from the whitened second moments: ``L^-T M L^-1 / 2``."""
    k_xx, k_yx, k_yy = (
        np.float64(record[layout.K_XX]),
        np.float64(record[layout.K_YX]),
        np.float64(record[layout.K_YY]),
    )
    half = 0.5 / _ROOT**4
    pp, pq, qq = half * total[layout.H_PP], half * total[layout.H_PQ], half * total[layout.H_QQ]
    out[0] = k_xx * k_xx * pp + 2 * k_xx * k_yx * pq + k_yx * k_yx * qq
    out[1] = k_yy * (k_xx * pq + k_yx * qq)
    out[2] = k_yy * k_yy * qq


@helper
def _opacity_gradient(record, total, m, low_pass, antialiased, d_m):
    """``dL/d opacity``; under anti-aliasing also what the compensation sends to ``m``."""
    opacity = np.float64(record[layout.OPACITY])
    d_opacity = total[layout.H] / opacity
    if not antialiased:
        return d_opacity
    nx, ny, nz = m[1] * m[5] - m[2] * m[4], m[2] * m[3] - m[0] * m[5], m[0] * m[4] - m[1] * m[3]
    bare = nx * nx + ny * ny + nz * nz
    trace = m[0] * m[0] + m[1] * m[1] + m[2] * m[2] + m[3] * m[3] + m[4] * m[4] + m[5] * m[5]
    determinant = bare + low_pass * trace + low_pass * low_pass
    # ln(compensation) = (ln bare - ln determinant) / 2 and dL / d ln(compensation) = H.
    d_bare = 0.5 * total[layout.H] * (1.0 / bare - 1.0 / determinant)
    d_trace = -0.5 * total[layout.H] * low_pass / determinant
    d_m[0] += 2 * (d_bare * (m[4] * nz - m[5] * ny) + d_trace * m[0])
    d_m[1] += 2 * (d_bare * (m[5] * nx - m[3] * nz) + d_trace * m[1])
    d_m[2] += 2 * (d_bare * (m[3] * ny - m[4] * nx) + d_trace * m[2])
    d_m[3] += 2 * (d_bare * (ny * m[2] - nz * m[1]) + d_trace * m[3])
    d_m[4] += 2 * (d_bare * (nz * m[0] - nx * m[2]) + d_trace * m[4])
    d_m[5] += 2 * (d_bare * (nx * m[1] - ny * m[0]) + d_trace * m[5])
    return d_opacity * math.sqrt(bare / determinant)


@helper
def _point_gradient(view, point, d_u, d_v, d_z, d_affine, out):
    """``dL/d point`` in the camera, from the centre, the depth and the local affine map."""
    inverse = 1.0 / point[2]
    x, y = point[0] * inverse, point[1] * inverse
    held_x = min(max(x, view[layout.X_LOW]), view[layout.X_HIGH])
    held_y = min(max(y, view[layout.Y_LOW]), view[layout.Y_HIGH])
    fx, fy = view[layout.FX] * inverse, view[layout.FY] * inverse
    # dL/dJ = dL/d(JW) W^T, of which four entries are not constant.
    d_xx, d_xz, d_yy, d_yz = 0.0, 0.0, 0.0, 0.0
    for j in range(3):
        d_xx += d_affine[j] * view[layout.ROTATION + j]
        d_xz += d_affine[j] * view[layout.ROTATION + 6 + j]
        d_yy += d_affine[3 + j] * view[layout.ROTATION + 3 + j]
        d_yz += d_affine[3 + j] * view[layout.ROTATION + 6 + j]
    # J_xx = fx / z and J_xz = -(fx / z) held_x, where held_x is x / z or a constant.
    d_held_x = -fx * d_xz if held_x == x else 0.0
    d_held_y = -fy * d_yz if held_y == y else 0.0
    out[0] = fx * d_u + inverse * d_held_x
    out[1] = fy * d_v + inverse * d_held_y
    out[2] = (
        d_z
        - x * fx * d_u
        - y * fy * d_v
        - inverse * (fx * (d_xx - held_x * d_xz) + fy * (d_yy - held_y * d_yz) + x * d_held_x + y * d_held_y)
    )


@helper
def _quaternion_gradient(quaternion, d_rotation, out):
    """``dL/dq`` of a quaternion of any norm; zero for the zero quaternion, whose rotation is constant."""
    w, x = np.float64(quaternion[0]), np.float64(quaternion[1])
    y, z = np.float64(quaternion[2]), np.float64(quaternion[3])
    norm = math.sqrt(w * w + x * x + y * y + z * z)
    out[:] = 0.0
    if norm == 0:
        return
    w, x, y, z = w / norm, x / norm, y / norm, z / norm
    d = d_rotation
    d_w = 2 * (x * (d[7] - d[5]) + y * (d[2] - d[6]) + z * (d[3] - d[1]))
    d_x = 2 * (y * (d[1] + d[3]) + z * (d[2] + d[6]) + w * (d[7] - d[5]) - 2 * x * (d[4] + d[8]))
    d_y = 2 * (x * (d[1] + d[3]) + z * (d[5] + d[7]) + w * (d[2] - d[6]) - 2 * y * (d[0] + d[8]))
    d_z = 2 * (x * (d[2] + d[6]) + y * (d[5] + d[7]) + w * (d[3] - d[1]) - 2 * z * (d[0] + d[4]))
    along = d_w * w + d_x * x + d_y * y + d_z * z
    out[0], out[1] = (d_w - along * w) / norm, (d_x - along * x) / norm
    out[2], out[3] = (d_y - along * y) / norm, (d_z - along * z) / norm


@helper
def _splat_gradient(view, mean, root, record, total, low_pass, antialiased, work, d_mean, d_root):
    """Add one splat's gradients to those of its Gaussian's mean and ``R S``; returns ``dL/d opacity``."""
    point, affine, m = work[0:3], work[3:9], work[9:15]
    d_m, d_affine, d_cov, d_point = work[15:21], work[21:27], work[27:30], work[30:33]
    _camera_point(view, mean, point)
    _affine(view, point, affine)
    for i in range(0, 6, 3):
        for j in range(3):
            m[i + j] = affine[i] * root[j] + affine[i + 1] * root[3 + j] + affine[i + 2] * root[6 + j]
    _covariance_gradient(record, total, d_cov)
    for j in range(3):
        d_m[j] = 2 * (d_cov[0] * m[j] + d_cov[1] * m[3 + j])
        d_m[3 + j] = 2 * (d_cov[1] * m[j] + d_cov[2] * m[3 + j])
    d_opacity = _opacity_gradient(record, total, m, low_pass, antialiased, d_m)
    for k in range(3):
        for j in range(3):
            d_root[3 * k + j] += affine[k] * d_m[j] + affine[3 + k] * d_m[3 + j]
        d_affine[k] = d_m[0] * root[3 * k] + d_m[1] * root[3 * k + 1] + d_m[2] * root[3 * k + 2]
        d_affine[3 + k] = d_m[3] * root[3 * k] + d_m[4] * root[3 * k + 1] + d_m[5] * root[3 * k + 2]
    # dL/d centre = L^-T (H_P, H_Q).
    scale = 1.0 / _ROOT**2
    d_u = scale * (record[layout.K_XX] * total[layout.H_P] + record[layout.K_YX] * total[layout.H_Q])
    d_v = scale * record[layout.K_YY] * total[layout.H_Q]
    _point_gradient(view, point, d_u, d_v, total[layout.D_DEPTH], d_affine, d_point)
    for j in range(3):
        for i in range(3):
            d_mean[j] += view[layout.ROTATION + 3 * i + j] * d_point[i]
    return d_opacity


@kernel
def unproject(
    means,
    quaternions,
    scales,
    root,
    views,
    first_view,
    last_view,
    first,
    last,
    shifts,
    low_pass,
    antialiased,
    records,
    rects,
    entry_starts,
    gradients,
    d_means,
    d_quaternions,
    d_scales,
    d_opacities,
    d_colors,
):
    """Gradients of Gaussians ``first`` to ``last``, summed over the views that show them."""
    channels = d_colors.shape[1]
    total, work = np.empty(gradients.shape[1]), np.empty(33)
    d_mean, d_root, d_rotation, rotation = np.empty(3), np.empty(9), np.empty(9), np.empty(9)
    d_quaternion, d_color = np.empty(4), np.empty(channels)
    for n in range(first, last):
        d_mean[:], d_root[:], d_color[:] = 0.0, 0.0, 0.0
        d_opacity = 0.0
        for v in range(first_view, last_view):
            s = n - shifts[v]
            if rects[s, 0] == rects[s, 1]:
                continue
            _entry_sum(gradients, entry_starts[s], entry_starts[s + 1], total)
            d_opacity += _splat_gradient(
                views[v], means[n], root[n], records[s], total, low_pass, antialiased, work, d_mean, d_root
            )
            for c in range(channels):
                d_color[c] += total[layout.COLOR + c]
        _rotation(quaternions[n], rotation)
        for j in range(3):
            d_scale = 0.0
            for i in range(3):
                d_scale += d_root[3 * i + j] * rotation[3 * i + j]
                d_rotation[3 * i + j] = d_root[3 * i + j] * scales[n, j]
            d_scales[n, j], d_means[n, j] = d_scale, d_mean[j]
        _quaternion_gradient(quaternions[n], d_rotation, d_quaternion)
        for k in range(4):
            d_quaternions[n, k] = d_quaternion[k]
        for c in range(channels):
            d_colors[n, c] = d_color[c]
        d_opacities[n] = d_opacity
