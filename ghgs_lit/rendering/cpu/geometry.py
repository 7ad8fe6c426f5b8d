"""The geometry of eight splats at once, which projection and its gradient share; in doubles.

Points and vectors are tuples of vectors of eight doubles; matrices are such tuples row by row. Doubles
cost little (once a splat, not once a pixel) and leave no finite float32 input that overflows.
"""

import math

from ghgs_lit.rendering.cpu import layout, simd
from ghgs_lit.rendering.cpu.compile import helper

# p^2 + q^2 = sigma / ln 2, where sigma is the exponent of the Gaussian.
TO_LOG2 = 1.0 / math.log(2.0)
K_SCALE = math.sqrt(0.5 * TO_LOG2)


@helper
def gather(array, first, last, out):
    """Rows ``first`` to ``first + 8`` of ``array`` [n, k] into rows of 8 of ``out``; ``last`` ends it."""
    for lane in range(simd.DOUBLES):
        n = min(first + lane, last - 1)
        for k in range(array.shape[1]):
            out[k * simd.DOUBLES + lane] = array[n, k]


@helper
def unit(quaternions):
    """Unit quaternions and 1 / norm from rows of components; identity and 0 for the zero quaternion."""
    one, zero = simd.full(1.0), simd.full(0.0)
    w, x = simd.load(quaternions, 0), simd.load(quaternions, 8)
    y, z = simd.load(quaternions, 16), simd.load(quaternions, 24)
    norm = simd.root(w * w + x * x + (y * y + z * z))
    is_zero = norm == zero
    inverse = one / simd.select(is_zero, one, norm)
    w = simd.select(is_zero, one, w * inverse)
    return w, x * inverse, y * inverse, z * inverse, simd.select(is_zero, zero, inverse)


@helper
def rotation(w, x, y, z):
    """Rotation matrices of unit quaternions."""
    one, two = simd.full(1.0), simd.full(2.0)
    return (
        one - two * (y * y + z * z), two * (x * y - w * z), two * (x * z + w * y),
        two * (x * y + w * z), one - two * (x * x + z * z), two * (y * z - w * x),
        two * (x * z - w * y), two * (y * z + w * x), one - two * (x * x + y * y),
    )  # fmt: skip


@helper
def dot(a, b, c, x, y, z):
    return simd.fma(a, x, simd.fma(b, y, c * z))


@helper
def camera_row(view, row, x, y, z):
    """One coordinate in the camera of world points."""
    first = layout.ROTATION + 3 * row
    a, b, c = simd.full(view[first]), simd.full(view[first + 1]), simd.full(view[first + 2])
    return dot(a, b, c, x, y, z) + simd.full(view[layout.TRANSLATION + row])


@helper
def camera_points(view, shared, stride, n):
    """World points of Gaussians ``n`` to ``n + 8`` in camera axes: x / z, y / z, z and 1 / z."""
    mean_x, mean_y = simd.load(shared, n), simd.load(shared, stride + n)
    mean_z = simd.load(shared, 2 * stride + n)
    z = camera_row(view, 2, mean_x, mean_y, mean_z)
    inverse = simd.full(1.0) / z
    x = camera_row(view, 0, mean_x, mean_y, mean_z) * inverse
    return x, camera_row(view, 1, mean_x, mean_y, mean_z) * inverse, z, inverse


@helper
def held(view, x, y):
    """x / z and y / z held near the frame, as the Jacobian takes them."""
    x = simd.minimum(simd.maximum(x, simd.full(view[layout.X_LOW])), simd.full(view[layout.X_HIGH]))
    y = simd.minimum(simd.maximum(y, simd.full(view[layout.Y_LOW])), simd.full(view[layout.Y_HIGH]))
    return x, y


@helper
def affine(view, x, y, inverse):
    """``J W``, 2 x 3: the local affine map of the projection, for held ``x`` and ``y``."""
    fx, fy = simd.full(view[layout.FX]) * inverse, simd.full(view[layout.FY]) * inverse
    r = layout.ROTATION
    a, b, c = simd.full(view[r + 6]), simd.full(view[r + 7]), simd.full(view[r + 8])
    return (
        fx * (simd.full(view[r]) - x * a), fx * (simd.full(view[r + 1]) - x * b),
        fx * (simd.full(view[r + 2]) - x * c), fy * (simd.full(view[r + 3]) - y * a),
        fy * (simd.full(view[r + 4]) - y * b), fy * (simd.full(view[r + 5]) - y * c),
    )  # fmt: skip


@helper
def load_root(shared, stride, n):
    """``R(q) S`` of Gaussians ``n`` to ``n + 8``."""
    at = layout.ROOT * stride + n
    return (
        simd.load(shared, at), simd.load(shared, at + stride), simd.load(shared, at + 2 * stride),
        simd.load(shared, at + 3 * stride), simd.load(shared, at + 4 * stride),
        simd.load(shared, at + 5 * stride), simd.load(shared, at + 6 * stride),
        simd.load(shared, at + 7 * stride), simd.load(shared, at + 8 * stride),
    )  # fmt: skip


@helper
def footprint(t, r):
    """``M = J W R(q) S``, 2 x 3, whose ``M M^T`` is the covariance before the low-pass filter."""
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
    """``m_0 x m_1`` of the rows of M; its square is ``det(M M^T)`` without cancellation."""
    return m[1] * m[5] - m[2] * m[4], m[2] * m[3] - m[0] * m[5], m[0] * m[4] - m[1] * m[3]


@helper
def determinants(m, n, low_pass):
    """``det(M M^T)``, the same after the low-pass filter, and the diagonal of ``M M^T``."""
    bare = dot(n[0], n[1], n[2], n[0], n[1], n[2])
    xx, yy = dot(m[0], m[1], m[2], m[0], m[1], m[2]), dot(m[3], m[4], m[5], m[3], m[4], m[5])
    return bare, bare + low_pass * (xx + yy) + low_pass * low_pass, xx, yy
