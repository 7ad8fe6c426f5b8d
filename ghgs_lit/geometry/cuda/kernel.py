"""Photo-consistency for a GPU, in Triton: formulas of
:mod:`ghgs_lit.geometry.photo_consistency`."""

import triton
import triton.language as tl
from torch import Tensor

from ghgs_lit.kernels.tiles import between, cells, load3, load4, rows_of, start, store3


@triton.jit
def _row(x, y, z, first, second, third):
    """The product of a row with a matrix of three rows.

    Args:
        x: first number of the row.
        y: second number.
        z: third number.
        first: first row of the matrix, three numbers.
        second: second row.
        third: third row.

    Returns:
        Three numbers.
    """
    return (
        x * first[0] + y * second[0] + z * third[0],
        x * first[1] + y * second[1] + z * third[1],
        x * first[2] + y * second[2] + z * third[2],
    )


@triton.jit
def relations_rows(count, intrinsics, extrinsics, turn, shift, facing, views, ROWS: tl.constexpr):
    """Write what leads from pixels of view j to those of view k, for rows (element, j, k).

    Args:
        count: number of rows B V V.
        intrinsics: K [B, V, 3, 3].
        extrinsics: world to camera [B, V, 4, 4].
        turn: for the matrices [B, V, V, 3, 3].
        shift: for what is added in view k [B, V, V, 3].
        facing: for the cosines between the axes of the views [B, V, V].
        views: V.
        ROWS: rows of a program.
    """
    i = rows_of(count, ROWS)
    k = i // (views * views) * views + i % views
    j = i // views
    a, b, c, of_a = load4(extrinsics, 4 * j)
    d, e, f, of_b = load4(extrinsics, 4 * j + 1)
    g, h, m, of_c = load4(extrinsics, 4 * j + 2)
    # Rows of R_j^T, and of R_k R_j^T.
    back = (a, d, g), (b, e, h), (c, f, m)
    x, y, z, moved_a = load4(extrinsics, 4 * k)
    one = _row(x, y, z, back[0], back[1], back[2])
    x, y, z, moved_b = load4(extrinsics, 4 * k + 1)
    two = _row(x, y, z, back[0], back[1], back[2])
    x, y, z, moved_c = load4(extrinsics, 4 * k + 2)
    three = _row(x, y, z, back[0], back[1], back[2])
    moved_a -= one[0] * of_a + one[1] * of_b + one[2] * of_c
    moved_b -= two[0] * of_a + two[1] * of_b + two[2] * of_c
    moved_c -= three[0] * of_a + three[1] * of_b + three[2] * of_c
    fx, skew, cx = load3(intrinsics, 3 * j)
    _, fy, cy = load3(intrinsics, 3 * j + 1)
    # Rows of K_j^-1, an upper triangular matrix.
    zero = tl.zeros_like(fx)
    unit = tl.zeros_like(fx) + 1
    top = (1 / fx, -skew / (fx * fy), (skew * cy / fy - cx) / fx)
    middle = (zero, 1 / fy, -cy / fy)
    one = _row(one[0], one[1], one[2], top, middle, (zero, zero, unit))
    two = _row(two[0], two[1], two[2], top, middle, (zero, zero, unit))
    tl.store(facing + i, three[2])
    three = _row(three[0], three[1], three[2], top, middle, (zero, zero, unit))
    fx, skew, cx = load3(intrinsics, 3 * k)
    _, fy, cy = load3(intrinsics, 3 * k + 1)
    x, y, z = _row(fx, skew, cx, one, two, three)
    store3(turn, 3 * i, x, y, z)
    x, y, z = _row(zero, fy, cy, one, two, three)
    store3(turn, 3 * i + 1, x, y, z)
    store3(turn, 3 * i + 2, three[0], three[1], three[2])
    store3(shift, i, fx * moved_a + skew * moved_b + cx * moved_c, fy * moved_b + cy * moved_c, moved_c)


@triton.jit
def smoothed_rows(count, photo, masks, out, height, width, ROWS: tl.constexpr):
    """Write the four channels of ``ROWS`` pixels.

    Args:
        count: number of pixels of all images.
        photo: colours of the surface [B, V, 3, H, W].
        masks: of the subject [B, V, H, W].
        out: for mean colours and masks [B, V, 4, H, W].
        height: H.
        width: W.
        ROWS: pixels of a program.
    """
    i = rows_of(count, ROWS)
    area = height * width
    image = i // area
    row = i % area // width
    column = i % width
    red = tl.zeros_like(i).to(tl.float32)
    green = tl.zeros_like(i).to(tl.float32)
    blue = tl.zeros_like(i).to(tl.float32)
    number = tl.zeros_like(i).to(tl.float32)
    center = tl.zeros_like(i).to(tl.float32)
    for k in tl.static_range(9):
        y = row + k // 3 - 1
        x = column + k % 3 - 1
        inside = (y >= 0) & (y < height) & (x >= 0) & (x < width)
        place = y * width + x
        inside &= tl.load(masks + image * area + place, inside, 0) != 0
        at = photo + image * 3 * area + place
        r = tl.load(at, inside, 0.0)
        g = tl.load(at + area, inside, 0.0)
        b = tl.load(at + 2 * area, inside, 0.0)
        inside &= (r + g + b) - (r + g + b) == 0  # finite
        red = red + tl.where(inside, r, 0.0)
        green = green + tl.where(inside, g, 0.0)
        blue = blue + tl.where(inside, b, 0.0)
        number = number + tl.where(inside, 1.0, 0.0)
        if k == 4:
            center = tl.where(inside, 1.0, 0.0)
    scale = 1 / tl.maximum(number, 1.0)
    at = out + image * 4 * area + row * width + column
    tl.store(at, red * scale)
    tl.store(at + area, green * scale)
    tl.store(at + 2 * area, blue * scale)
    tl.store(at + 3 * area, center)


@triton.jit
def swept_rows(
    count, pixels, near, far, colors, turn, shift, compared, out, steps, views, height, width, tolerance,
    ROWS: tl.constexpr,
):  # fmt: skip
    """Write the agreement of ``ROWS`` pixels at depths.

    Args:
        count: pixels times depths, N S.
        pixels: indices among those of all images [N].
        near: least depth of each [N].
        far: largest depth of each [N].
        colors: smoothed photographs and their masks [B, V, 4, H, W].
        turn: matrices from pixels of a view (second axis) to another (third axis) [B, V, V, 3, 3].
        shift: what is added in the other view [B, V, V, 3].
        compared: whether two views are compared [B, V, V].
        out: for the agreement [N, S].
        steps: S.
        views: V.
        height: H.
        width: W.
        tolerance: mean difference of colours at which the agreement is 1 / e.
        ROWS: rows of a program.
    """
    i = rows_of(count, ROWS)
    n = i // steps
    step = i % steps
    area = height * width
    pixel = tl.load(pixels + n)
    low = tl.load(near + n)
    image = pixel // area
    place = pixel % area
    u = (place % width).to(tl.float32) + 0.5
    v = (place // width).to(tl.float32) + 0.5
    depth = low + (tl.load(far + n) - low) * ((step.to(tl.float32) + 0.5) / steps)
    at = colors + image * 4 * area + place
    red = tl.load(at)
    green = tl.load(at + area)
    blue = tl.load(at + 2 * area)
    best = tl.zeros_like(depth)
    for other in range(1, views):
        k = (image + other) % views
        pair = image * views + k
        a, b, c = load3(turn, 3 * pair)
        x = a * u + b * v + c
        a, b, c = load3(turn, 3 * pair + 1)
        y = a * u + b * v + c
        a, b, c = load3(turn, 3 * pair + 2)
        z = a * u + b * v + c
        a, b, c = load3(shift, pair)
        x = x * depth + a
        y = y * depth + b
        z = z * depth + c
        is_front = z > 0
        z = tl.where(is_front, z, 1.0)
        left, right, before, after = cells(x / z, width)
        top, bottom, above, below = cells(y / z, height)
        top = top * width
        bottom = bottom * width
        there = colors + (image // views * views + k) * 4 * area
        r = between(there, top, bottom, left, right, above, below, before, after)
        g = between(there + area, top, bottom, left, right, above, below, before, after)
        b = between(there + 2 * area, top, bottom, left, right, above, below, before, after)
        seen = between(there + 3 * area, top, bottom, left, right, above, below, before, after)
        difference = (tl.abs(r - red) + tl.abs(g - green) + tl.abs(b - blue)) / 3
        agreement = tl.exp(-difference / tolerance) * seen
        is_compared = is_front & (tl.load(compared + pair) != 0)
        best = tl.maximum(best, tl.where(is_compared, agreement, 0.0))
    tl.store(out + i, best)


def relations(intrinsics: Tensor, extrinsics: Tensor) -> tuple[Tensor, ...]:
    """The operator of :mod:`ghgs_lit.geometry.photo_consistency`."""
    b, views = intrinsics.shape[:2]
    out = tuple(intrinsics.new_empty(b, views, views, *size) for size in ((3, 3), (3,), ()))
    start(relations_rows, b * views * views, intrinsics, extrinsics, *out, views)
    return out


def smoothed(photo: Tensor, masks: Tensor) -> Tensor:
    """The operator of :mod:`ghgs_lit.geometry.photo_consistency`."""
    b, views, height, width = masks.shape
    out = photo.new_empty(b, views, 4, height, width)
    start(smoothed_rows, masks.numel(), photo, masks, out, height, width)
    return out


def swept(*inputs) -> Tensor:
    """The operator of :mod:`ghgs_lit.geometry.photo_consistency`."""
    *tensors, steps, tolerance = inputs
    pixels, near, _, colors = tensors[:4]
    views, _, height, width = colors.shape[1:]
    out = near.new_empty(len(pixels), steps)
    start(swept_rows, out.numel(), *tensors, out, steps, views, height, width, tolerance)
    return out
