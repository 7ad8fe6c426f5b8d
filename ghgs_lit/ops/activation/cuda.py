"""Triton kernels of the activations of Gaussians and of their gradients, ``ROWS`` Gaussians per program.

The formulas are in :mod:`ghgs_lit.ops.activation`. A Gaussian reads at most 45 numbers, so that the
backward pass recomputes intermediate values instead of storing them."""

import triton
import triton.language as tl
from torch import Tensor

from ghgs_lit.ops import activation
from ghgs_lit.ops.tiles import clamp, load3, load4, rows_of, start, store3, store4, tanh

SIGMOID = tl.constexpr(activation.SIGMOID_LIMIT)
TANH = tl.constexpr(activation.TANH_LIMIT)
SHORTEST = tl.constexpr(activation.SHORTEST)
FAR = tl.constexpr(activation.OTHER)
RANGE = tl.constexpr(activation.OTHER - activation.SAME)


@triton.jit
def unit_quaternion(w, x, y, z):
    """Normalised quaternions and their length; 0 stays 0. The largest number is divided out first."""
    largest = tl.maximum(tl.maximum(tl.abs(w), tl.abs(x)), tl.maximum(tl.abs(y), tl.abs(z)))
    scale = 1 / tl.where(largest == 0, 1.0, largest)
    w = w * scale
    x = x * scale
    y = y * scale
    z = z * scale
    squared = w * w + x * x + y * y + z * z
    length = tl.sqrt(tl.where(largest == 0, 1.0, squared))
    scale = 1 / length
    return w * scale, x * scale, y * scale, z * scale, largest * length


@triton.jit
def product(a, b, c, d, w, x, y, z):
    """Product of two quaternions."""
    return (
        a * w - b * x - c * y - d * z,
        a * x + b * w + c * z - d * y,
        a * y - b * z + c * w + d * x,
        a * z + b * y - c * x + d * w,
    )


@triton.jit
def rotated(w, a, b, c, x, y, z):
    """Rotate the vector (x, y, z) by the unit quaternion (w, a, b, c)."""
    p = 2 * (b * z - c * y)
    q = 2 * (c * x - a * z)
    r = 2 * (a * y - b * x)
    return x + w * p + (b * r - c * q), y + w * q + (c * p - a * r), z + w * r + (a * q - b * p)


@triton.jit
def _better(one, other, at: tl.constexpr):
    """Select the row of Shepperd's table with the larger diagonal number, at index ``at`` of ``other``."""
    is_better = other[at] > one[4]
    w = tl.where(is_better, other[0], one[0])
    x = tl.where(is_better, other[1], one[1])
    y = tl.where(is_better, other[2], one[2])
    z = tl.where(is_better, other[3], one[3])
    return w, x, y, z, tl.where(is_better, other[at], one[4])


@triton.jit
def _to_world(extrinsics, image):
    """Quaternion from camera axes to the world (Shepperd 1978)."""
    a, ba, ca, _ = load4(extrinsics, image * 4)
    ab, b, cb, _ = load4(extrinsics, image * 4 + 1)
    ac, bc, c, _ = load4(extrinsics, image * 4 + 2)
    x = cb - bc
    y = ac - ca
    z = ba - ab
    xy = ba + ab
    xz = ac + ca
    yz = cb + bc
    best = (1 + a + b + c, x, y, z, 1 + a + b + c)
    best = _better(best, (x, 1 + a - b - c, xy, xz), 1)
    best = _better(best, (y, xy, 1 - a + b - c, yz), 2)
    best = _better(best, (z, xz, yz, 1 - a - b + c), 3)
    return unit_quaternion(best[0], best[1], best[2], best[3])


@triton.jit
def _neighbour(depth, valid, image, row, column, own, footprint, height, width):
    """Depth difference of a neighbour, which may be outside the image, times its weight in [0, 1], and the
    weight, which is 0 on another surface."""
    inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
    place = (image * height + row) * width + column
    is_valid = inside & (tl.load(valid + place, inside, 0) != 0)
    deeper = tl.load(depth + place, is_valid, float("inf")) - own
    near = clamp((tl.abs(deeper) / footprint - FAR) / -RANGE, 0.0, 1.0)
    return near * tl.where(near > 0, deeper, 0.0), near


@triton.jit
def _slope(depth, valid, image, row, column, down, right, own, footprint, height, width):
    """Relative depth change from a pixel to the next one, ``down`` rows and ``right`` columns away."""
    after, near = _neighbour(depth, valid, image, row + down, column + right, own, footprint, height, width)
    before, other = _neighbour(depth, valid, image, row - down, column - right, own, footprint, height, width)
    return (after - before) / ((1 + near * other) * own + after + before)


@triton.jit
def surface_axes(depth, valid, intrinsics, extrinsics, image, pixel, own, height, width):
    """Quaternion from surface axes to the world.

    Args:
        depth: in metres [images, height, width].
        valid: whether depths are valid [images, height, width].
        intrinsics: in pixels [images, 3, 3].
        extrinsics: world to camera [images, 4, 4].
        image: index of the image.
        pixel: row-major index of the pixel.
        own: depth of the pixel in metres.
        height: height of the images in pixels.
        width: width of the images in pixels.
    """
    row = pixel // width
    column = pixel % width
    fx, skew, cx = load3(intrinsics, image * 3)
    _, fy, cy = load3(intrinsics, image * 3 + 1)
    right = _slope(depth, valid, image, row, column, 0, 1, own, own / fx, height, width)
    down = _slope(depth, valid, image, row, column, 1, 0, own, own / fx, height, width)
    toward = 1 + right * (column + 0.5 - cx) + down * (row + 0.5 - cy)
    x = -fx * right
    y = -skew * right - fy * down
    length = tl.sqrt(x * x + y * y + toward * toward)
    w, a, b, c, _ = _to_world(extrinsics, image)
    p, q, r, s, _ = unit_quaternion(length + toward, -y, x, tl.zeros_like(x))
    return product(w, a, b, c, p, q, r, s)


@triton.jit
def _sigmoid(x):
    """Sigmoid of ``x`` clamped to its limit, and its slope, which is exact also where the sigmoid is
    nearly 1."""
    x = clamp(x, -SIGMOID, SIGMOID)
    shrunk = tl.exp(-tl.abs(x))
    other = 1 / (1 + shrunk)
    return tl.where(x < 0, shrunk * other, other), shrunk * other * other


@triton.jit
def _back(slope, own, x, limit):
    """Gradient of an activation with slope ``own``; beyond the limit, only a gradient that leads back
    remains."""
    return tl.where((tl.abs(x) <= limit) | (slope * x > 0), slope * own, 0.0)


@triton.jit
def _tanh_back(slope, x):
    """Gradient of a clamped tanh."""
    shrunk = tl.exp(-2 * tl.abs(clamp(x, -TANH, TANH)))
    return _back(slope, 4 * shrunk / ((1 + shrunk) * (1 + shrunk)), x, TANH)


@triton.jit
def _depth_and_footprint(depth, intrinsics, image, place):
    """Depths at pixels, indexed over all images, and the sides of the pixels at these depths, in metres."""
    own = tl.load(depth + place)
    fx = tl.load(intrinsics + image * 9)
    fy = tl.load(intrinsics + image * 9 + 4)
    return own, own / tl.sqrt(fx * fy)


@triton.jit
def _offset(x, limit, unit, HAS_LIMIT: tl.constexpr):
    """One coordinate of an offset in metres, from its raw value."""
    return limit * tanh(clamp(x, -TANH, TANH)) if HAS_LIMIT else unit * x


@triton.jit
def _offset_back(slope, x, limit, unit, HAS_LIMIT: tl.constexpr):
    """Gradient of the raw value of one coordinate of an offset."""
    return _tanh_back(limit * slope, x) if HAS_LIMIT else unit * slope


@triton.jit
def activate_rows(
    count, offset, scale, rotation, opacity, color, image, pixel, depth, valid, points, photo, share,
    intrinsics, extrinsics, means, quaternions, scales, opacities, colors, height, width,
    limit, unit, inward, floor, span, across, thickness, least, bias, change,
    HAS_LIMIT: tl.constexpr, HAS_COLOR: tl.constexpr, HAS_SHARE: tl.constexpr, ON_SURFACE: tl.constexpr,
    ROWS: tl.constexpr,
):  # fmt: skip
    """Write ``ROWS`` Gaussians; see :func:`activate`.

    Args:
        count: number N of Gaussians.
        offset, scale, rotation, opacity, color: raw, [N, 3], [N, 3], [N, 4], [N] and [N, 3].
        image: index of each Gaussian's image (``b * V + v``) [N].
        pixel: row-major index of its pixel [N].
        depth, valid: depths in metres, and whether they are valid [B, V, height, width].
        points: world points in metres [B, V, height, width, 3].
        photo: colours [B, V, 3, height, width].
        share: factors of the opacities [B, V, height, width].
        intrinsics, extrinsics: [B, V, 3, 3] in pixels, and [B, V, 4, 4].
        means, quaternions, scales, opacities, colors: written, [N, 3], [N, 4], [N, 3], [N] and
            [N, 3].
        height, width: size of the images in pixels.
        limit, unit, inward, floor, span, across, thickness, least, bias, change: fields of
            :class:`ghgs_lit.ops.activation.Constants`, in order.
        HAS_LIMIT, HAS_COLOR, HAS_SHARE: whether offsets are limited, and raw colours and factors given.
        ON_SURFACE: raw values refer to surface axes.
        ROWS: Gaussians per program.
    """
    i = rows_of(count, ROWS)
    view = tl.load(image + i)
    at = tl.load(pixel + i)
    place = view * height * width + at
    own, footprint = _depth_and_footprint(depth, intrinsics, view, place)
    x, y, z = load3(offset, i)
    x = _offset(x, limit, unit, HAS_LIMIT)
    y = _offset(y, limit, unit, HAS_LIMIT)
    z = _offset(z, limit, unit, HAS_LIMIT) + inward * footprint
    w, a, b, c = load4(rotation, i)
    w, a, b, c, _ = unit_quaternion(w + 1, a, b, c)
    if ON_SURFACE:
        p, q, r, s = surface_axes(depth, valid, intrinsics, extrinsics, view, at, own, height, width)
        x, y, z = rotated(p, q, r, s, x, y, z)
        w, a, b, c = product(p, q, r, s, w, a, b, c)
    u, v, t = load3(points, place)
    store3(means, i, u + x, v + y, t + z)
    store4(quaternions, i, w, a, b, c)
    for k in tl.static_range(3):
        raw = tl.load(scale + 3 * i + k) + (thickness if k == 2 else across)
        tl.store(scales + 3 * i + k, footprint * (floor * tl.exp(span * _sigmoid(raw)[0])))
        shade = tl.load(photo + (view * 3 + k) * height * width + at)
        if HAS_COLOR:
            shade += change * tanh(clamp(tl.load(color + 3 * i + k), -TANH, TANH))
        tl.store(colors + 3 * i + k, shade)
    shown = least + (1 - least) * _sigmoid(tl.load(opacity + i) + bias)[0]
    if HAS_SHARE:
        shown *= tl.load(share + place)
    tl.store(opacities + i, shown)


@triton.jit
def activate_back_rows(
    count, offset, scale, rotation, opacity, color, image, pixel, depth, valid, share, intrinsics, extrinsics,
    of_means, of_quaternions, of_scales, of_opacities, of_colors,
    d_offset, d_scale, d_rotation, d_opacity, d_color, d_points, height, width,
    limit, unit, inward, floor, span, across, thickness, least, bias, change,
    HAS_LIMIT: tl.constexpr, HAS_COLOR: tl.constexpr, HAS_SHARE: tl.constexpr, ON_SURFACE: tl.constexpr,
    ROWS: tl.constexpr,
):  # fmt: skip
    """Write the gradients of ``ROWS`` Gaussians; see :func:`activate_back`.

    Args:
        count: number N of Gaussians.
        offset, scale, rotation, opacity, color: raw, [N, 3], [N, 3], [N, 4], [N] and [N, 3].
        image: index of each Gaussian's image (``b * V + v``) [N].
        pixel: row-major index of its pixel [N].
        depth, valid: depths in metres, and whether they are valid [B, V, height, width].
        share: factors of the opacities [B, V, height, width].
        intrinsics, extrinsics: [B, V, 3, 3] in pixels, and [B, V, 4, 4].
        of_means, of_quaternions, of_scales, of_opacities, of_colors: gradients of the results.
        d_offset, d_scale, d_rotation, d_opacity, d_color: written, gradients of raw values.
        d_points: accumulated, gradients of points [B, V, height, width, 3].
        height, width: size of the images in pixels.
        limit, unit, inward, floor, span, across, thickness, least, bias, change: fields of
            :class:`ghgs_lit.ops.activation.Constants`, in order.
        HAS_LIMIT, HAS_COLOR, HAS_SHARE: whether offsets are limited, and raw colours and factors given.
        ON_SURFACE: raw values refer to surface axes.
        ROWS: Gaussians per program.
    """
    i = rows_of(count, ROWS)
    view = tl.load(image + i)
    at = tl.load(pixel + i)
    place = view * height * width + at
    own, footprint = _depth_and_footprint(depth, intrinsics, view, place)
    x, y, z = load3(of_means, i)
    # Added, since a pixel may be listed more than once; masked in rows that repeat the last one.
    is_own = tl.program_id(0).to(tl.int64) * ROWS + tl.arange(0, ROWS) < count
    tl.atomic_add(d_points + 3 * place, x, is_own)
    tl.atomic_add(d_points + 3 * place + 1, y, is_own)
    tl.atomic_add(d_points + 3 * place + 2, z, is_own)
    w, a, b, c = load4(of_quaternions, i)
    if ON_SURFACE:
        # The transpose of a rotation or of a product with a unit quaternion uses its conjugate.
        p, q, r, s = surface_axes(depth, valid, intrinsics, extrinsics, view, at, own, height, width)
        x, y, z = rotated(p, -q, -r, -s, x, y, z)
        w, a, b, c = product(p, -q, -r, -s, w, a, b, c)
    u, v, t = load3(offset, i)
    x = _offset_back(x, u, limit, unit, HAS_LIMIT)
    y = _offset_back(y, v, limit, unit, HAS_LIMIT)
    store3(d_offset, i, x, y, _offset_back(z, t, limit, unit, HAS_LIMIT))
    p, q, r, s = load4(rotation, i)
    p, q, r, s, length = unit_quaternion(p + 1, q, r, s)
    rate = tl.where(length == 0, 0.0, 1 / tl.where(length < SHORTEST, SHORTEST, length))
    along = p * w + q * a + r * b + s * c
    w = w - p * along
    a = a - q * along
    b = b - r * along
    c = c - s * along
    store4(d_rotation, i, rate * w, rate * a, rate * b, rate * c)
    for k in tl.static_range(3):
        raw = tl.load(scale + 3 * i + k) + (thickness if k == 2 else across)
        value, steep = _sigmoid(raw)
        slope = tl.load(of_scales + 3 * i + k) * footprint * (floor * tl.exp(span * value)) * span
        tl.store(d_scale + 3 * i + k, _back(slope, steep, raw, SIGMOID))
        if HAS_COLOR:
            slope = change * tl.load(of_colors + 3 * i + k)
            tl.store(d_color + 3 * i + k, _tanh_back(slope, tl.load(color + 3 * i + k)))
    raw = tl.load(opacity + i) + bias
    slope = (1 - least) * tl.load(of_opacities + i)
    if HAS_SHARE:
        slope *= tl.load(share + place)
    tl.store(d_opacity + i, _back(slope, _sigmoid(raw)[1], raw, SIGMOID))


def _flags(constants: list[float], color: Tensor | None, share: Tensor | None, on_surface: bool) -> dict:
    """Compile-time constants of the kernels."""
    flags = {"HAS_LIMIT": constants[0] > 0, "HAS_COLOR": color is not None, "HAS_SHARE": share is not None}
    return {**flags, "ON_SURFACE": on_surface}


def activate(*inputs) -> tuple[Tensor, ...]:
    """Kernel of the operator ``activate`` of :mod:`ghgs_lit.ops.activation`."""
    *tensors, constants, on_surface = inputs
    offset, color, image, depth, share = (tensors[k] for k in (0, 4, 5, 7, 11))
    out = [offset.new_empty(len(image), *size) for size in ((3,), (4,), (3,), (), (3,))]
    flags = _flags(constants, color, share, on_surface)
    start(activate_rows, len(image), *tensors, *out, *depth.shape[-2:], *constants, **flags)
    return tuple(out)


def activate_back(*inputs) -> list[Tensor]:
    """Kernel of the operator ``activate_back`` of :mod:`ghgs_lit.ops.activation`."""
    *tensors, constants, on_surface, slopes = inputs
    offset, color, image, depth, points, share = (tensors[k] for k in (0, 4, 5, 7, 9, 11))
    gradients = [offset.new_empty(0 if x is None else x.shape) for x in tensors[:5]]
    gradients.append(points.new_zeros(points.shape))
    given = (*tensors[:9], *tensors[11:], *slopes, *gradients)
    flags = _flags(constants, color, share, on_surface)
    start(activate_back_rows, len(image), *given, *depth.shape[-2:], *constants, **flags)
    return gradients
