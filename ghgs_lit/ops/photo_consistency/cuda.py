"""Triton kernel of photo-consistency; the formulas are in :mod:`ghgs_lit.ops.photo_consistency`."""

import triton
import triton.language as tl
from torch import Tensor

from ghgs_lit.ops.tiles import between, cells, load3, rows_of, start


@triton.jit
def swept_rows(
    count, pixels, near, far, colors, turn, shift, compared, out, steps, views, height, width, tolerance,
    ROWS: tl.constexpr,
):  # fmt: skip
    """Write ``ROWS`` values of agreement, each of a pixel at a depth.

    Args:
        count: pixels times depths, N S.
        pixels: indices among the pixels of all images [N].
        near: smallest depth of each pixel [N].
        far: largest depth of each pixel [N].
        colors: smoothed images and their masks [B, V, 4, H, W].
        turn: matrices from pixels of a view (second axis) to another (third axis) [B, V, V, 3, 3].
        shift: added in the other view [B, V, V, 3].
        compared: whether two views are compared [B, V, V].
        out: written, the agreement [N, S].
        steps: S.
        views: V.
        height: H.
        width: W.
        tolerance: mean difference of colours at which the agreement is 1 / e.
        ROWS: rows per program.
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


def swept(*inputs) -> Tensor:
    """Kernel of the operator ``swept`` of :mod:`ghgs_lit.ops.photo_consistency`."""
    *tensors, height, width, steps, tolerance = inputs
    pixels, near, _, colors = tensors[:4]
    views = colors.shape[1]
    out = near.new_empty(len(pixels), steps)
    start(swept_rows, out.numel(), *tensors, out, steps, views, height, width, tolerance)
    return out
