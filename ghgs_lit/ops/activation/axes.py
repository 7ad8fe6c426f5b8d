"""Quaternions, and axes of surfaces from depths, for a GPU, in Triton.

Formulas are those of :mod:`ghgs_lit.ops.activation.surface`."""

import triton
import triton.language as tl

from ghgs_lit.ops.activation import surface
from ghgs_lit.ops.tiles import clamp, load3, load4

FAR = tl.constexpr(surface.OTHER)
RANGE = tl.constexpr(surface.OTHER - surface.SAME)


@triton.jit
def unit_quaternion(w, x, y, z):
    """Quaternions divided by their length, and the length; 0 stays 0.

    The largest number is divided out first.

    Args:
        w: real part.
        x: second part.
        y: third part.
        z: fourth part.
    """
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
    """The product of two quaternions.

    Args:
        a: real part of the first.
        b: its second part.
        c: its third part.
        d: its fourth part.
        w: real part of the second.
        x: its second part.
        y: its third part.
        z: its fourth part.
    """
    return (
        a * w - b * x - c * y - d * z,
        a * x + b * w + c * z - d * y,
        a * y - b * z + c * w + d * x,
        a * z + b * y - c * x + d * w,
    )


@triton.jit
def rotated(w, a, b, c, x, y, z):
    """The vector (x, y, z) rotated by a unit quaternion.

    Args:
        w: real part of the quaternion.
        a: its second part.
        b: its third part.
        c: its fourth part.
        x: first coordinate of the vector.
        y: second one.
        z: third one.
    """
    p = 2 * (b * z - c * y)
    q = 2 * (c * x - a * z)
    r = 2 * (a * y - b * x)
    return x + w * p + (b * r - c * q), y + w * q + (c * p - a * r), z + w * r + (a * q - b * p)


@triton.jit
def _better(one, other, at: tl.constexpr):
    """The row of Shepperd's table with the larger number ``at`` its diagonal."""
    is_better = other[at] > one[4]
    w = tl.where(is_better, other[0], one[0])
    x = tl.where(is_better, other[1], one[1])
    y = tl.where(is_better, other[2], one[2])
    z = tl.where(is_better, other[3], one[3])
    return w, x, y, z, tl.where(is_better, other[at], one[4])


@triton.jit
def _to_world(extrinsics, image):
    """The quaternion from axes of a camera to the world (Shepperd 1978)."""
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
    """How much deeper a neighbour is, times its weight from 0 to 1, and the weight:
    0 for another surface.

    Args:
        depth: [images, height, width] in metres.
        valid: [images, height, width], which depths are.
        image: number of the image.
        row: of the neighbour, perhaps outside the image.
        column: of the neighbour.
        own: depth of the pixel itself.
        footprint: side of the pixel there, in metres.
        height: of the images.
        width: of the images.
    """
    inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
    place = (image * height + row) * width + column
    is_valid = inside & (tl.load(valid + place, inside, 0) != 0)
    deeper = tl.load(depth + place, is_valid, float("inf")) - own
    near = clamp((tl.abs(deeper) / footprint - FAR) / -RANGE, 0.0, 1.0)
    return near * tl.where(near > 0, deeper, 0.0), near


@triton.jit
def _slope(depth, valid, image, row, column, down, right, own, footprint, height, width):
    """Relative change of depth from a pixel to the next along an axis.

    Args:
        depth: [images, height, width] in metres.
        valid: [images, height, width], which depths are.
        image: number of the image.
        row: of the pixel.
        column: of the pixel.
        down: rows to the next pixel.
        right: columns to the next pixel.
        own: depth of the pixel.
        footprint: side of the pixel there, in metres.
        height: of the images.
        width: of the images.
    """
    after, near = _neighbour(depth, valid, image, row + down, column + right, own, footprint, height, width)
    before, other = _neighbour(depth, valid, image, row - down, column - right, own, footprint, height, width)
    return (after - before) / ((1 + near * other) * own + after + before)


@triton.jit
def surface_axes(depth, valid, intrinsics, extrinsics, image, pixel, own, height, width):
    """The quaternion from axes of the surface to the world.

    Args:
        depth: [images, height, width] in metres.
        valid: [images, height, width], which depths are.
        intrinsics: [images, 3, 3] in pixels.
        extrinsics: [images, 4, 4].
        image: number of the image.
        pixel: row-major index.
        own: depth of the pixel.
        height: of the images.
        width: of the images.
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
