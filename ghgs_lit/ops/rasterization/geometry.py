"""Geometry of eight splats at once in double precision, for the projection and its gradient.

Points, vectors and matrices (row by row) are tuples of vectors of eight doubles. Double precision
costs little, since it is used per splat and not per pixel, and no finite float32 input overflows."""

import math

from ghgs_lit.ops import simd
from ghgs_lit.ops.compile import helper
from ghgs_lit.ops.rasterization import layout

# p^2 + q^2 = sigma / ln 2, where exp(-sigma) is the Gaussian.
TO_LOG2 = 1.0 / math.log(2.0)
K_SCALE = math.sqrt(0.5 * TO_LOG2)


@helper
def unit(quaternions):
    """Normalise quaternions (w, x, y, z); returns w, x, y, z and 1 / norm.

    A zero quaternion gives the identity and 0.
    """
    w, x, y, z = quaternions
    norm = simd.sqrt(w * w + x * x + (y * y + z * z))
    is_zero = norm == 0.0
    inverse = 1.0 / simd.select(is_zero, 1.0, norm)
    w = simd.select(is_zero, 1.0, w * inverse)
    return w, x * inverse, y * inverse, z * inverse, simd.select(is_zero, 0.0, inverse)


@helper
def rotation(w, x, y, z):
    """Rotation matrices of unit quaternions, row by row."""
    x2 = x + x
    y2 = y + y
    z2 = z + z
    xx = x * x2
    yy = y * y2
    zz = z * z2
    xy = x * y2
    xz = x * z2
    yz = y * z2
    wx = w * x2
    wy = w * y2
    wz = w * z2
    return (
        1.0 - (yy + zz), xy - wz, xz + wy,
        xy + wz, 1.0 - (xx + zz), yz - wx,
        xz - wy, yz + wx, 1.0 - (xx + yy),
    )  # fmt: skip


@helper
def scale_columns(r, s):
    """``R S``: the columns of the 3 x 3 matrix ``r`` times the three scales ``s``."""
    return (
        r[0] * s[0], r[1] * s[1], r[2] * s[2], r[3] * s[0], r[4] * s[1], r[5] * s[2],
        r[6] * s[0], r[7] * s[1], r[8] * s[2],
    )  # fmt: skip


@helper
def dot(a, b, c, x, y, z):
    """``a x + b y + c z``."""
    return simd.fma(a, x, simd.fma(b, y, c * z))


@helper
def camera_points(view, mean):
    """Transform world points to camera axes.

    Args:
        view: a camera, [VIEW].
        mean: x, y and z in metres.

    Returns:
        x / z, y / z, z and 1 / z.
    """
    r = layout.ROTATION
    t = layout.TRANSLATION
    z = dot(view[r + 6], view[r + 7], view[r + 8], mean[0], mean[1], mean[2]) + view[t + 2]
    inverse = 1.0 / z
    x = dot(view[r], view[r + 1], view[r + 2], mean[0], mean[1], mean[2]) + view[t]
    y = dot(view[r + 3], view[r + 4], view[r + 5], mean[0], mean[1], mean[2]) + view[t + 1]
    return x * inverse, y * inverse, z, inverse


@helper
def clamp_to_frame(view, x, y):
    """Clamp x / z and y / z to the frame and its margin, for the Jacobian."""
    x = simd.minimum(simd.maximum(x, view[layout.X_LOW]), view[layout.X_HIGH])
    y = simd.minimum(simd.maximum(y, view[layout.Y_LOW]), view[layout.Y_HIGH])
    return x, y


@helper
def affine(view, x, y, inverse):
    """``J W``, 2 x 3: the local affine map of the projection (EWA splatting, Zwicker et al. 2001).

    Args:
        view: a camera, [VIEW].
        x: x / z, from :func:`clamp_to_frame`.
        y: y / z, from :func:`clamp_to_frame`.
        inverse: 1 / z.
    """
    fx = view[layout.FX] * inverse
    fy = view[layout.FY] * inverse
    r = layout.ROTATION
    a = view[r + 6]
    b = view[r + 7]
    c = view[r + 8]
    return (
        fx * (view[r] - x * a), fx * (view[r + 1] - x * b), fx * (view[r + 2] - x * c),
        fy * (view[r + 3] - y * a), fy * (view[r + 4] - y * b), fy * (view[r + 5] - y * c),
    )  # fmt: skip


@helper
def footprint(t, r):
    """``M = J W R(q) S``, 2 x 3; ``M M^T`` is the covariance before the low-pass filter.

    Args:
        t: ``J W``, 2 x 3.
        r: ``R S``, 3 x 3.
    """
    return (
        dot(t[0], t[1], t[2], r[0], r[3], r[6]),
        dot(t[0], t[1], t[2], r[1], r[4], r[7]),
        dot(t[0], t[1], t[2], r[2], r[5], r[8]),
        dot(t[3], t[4], t[5], r[0], r[3], r[6]),
        dot(t[3], t[4], t[5], r[1], r[4], r[7]),
        dot(t[3], t[4], t[5], r[2], r[5], r[8]),
    )


@helper
def normal(m):
    """Cross product of the rows of M; its squared length is ``det(M M^T)`` without cancellation."""
    return m[1] * m[5] - m[2] * m[4], m[2] * m[3] - m[0] * m[5], m[0] * m[4] - m[1] * m[3]


@helper
def determinants(m, n, low_pass):
    """``det(M M^T)`` before and after the low-pass filter, and the diagonal of ``M M^T``.

    Args:
        m: 2 x 3, from :func:`footprint`.
        n: :func:`normal` of ``m``.
        low_pass: added variance in px^2.
    """
    bare = dot(n[0], n[1], n[2], n[0], n[1], n[2])
    xx = dot(m[0], m[1], m[2], m[0], m[1], m[2])
    yy = dot(m[3], m[4], m[5], m[3], m[4], m[5])
    return bare, bare + low_pass * (xx + yy) + low_pass * low_pass, xx, yy
