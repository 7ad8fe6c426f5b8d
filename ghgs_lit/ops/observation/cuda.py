"""Triton kernel of the observations of Gaussians; a row of a program is a Gaussian in a view.

Bilinear sampling follows ``grid_sample``."""

import triton
import triton.language as tl
from torch import Tensor

from ghgs_lit.ops.tiles import between, cells, load3, rows_of, start, tanh, to_camera

CHANNELS = tl.constexpr(11)


@triton.jit
def observe_rows(
    count, means, colors, image, intrinsics, extrinsics, photo, mask, drawn, alpha, depth, out,
    views, height, width, scale, ROWS: tl.constexpr,
):  # fmt: skip
    """Write ``ROWS`` observations of a Gaussian in a view; see :func:`observe`.

    Args:
        count: number of observations, N V.
        means: in metres [N, 3].
        colors: [N, 3].
        image: index of each Gaussian's image (``b * V + v``) [N].
        intrinsics: in pixels [B, V, 3, 3].
        extrinsics: world to camera [B, V, 4, 4].
        photo: input views [B, V, 3, height, width].
        mask: coverage of each pixel by the subject [B, V, height, width].
        drawn: rendered colours [B, V, 3, height, width].
        alpha: rendered opacities [B, V, 1, height, width].
        depth: rendered depths in metres [B, V, 1, height, width].
        out: written [N, V, 11].
        views: V.
        height: height of the views in pixels.
        width: width of the views in pixels.
        scale: scale of the distance behind the rendered surface, in metres.
        ROWS: observations per program.
    """
    i = rows_of(count, ROWS)
    gaussian = i // views
    turn = i % views
    own = tl.load(image + gaussian)
    view = own // views * views + (own + turn) % views
    x, y, z = load3(means, gaussian)
    x, y, z = to_camera(extrinsics, view, x, y, z)
    fx, skew, cx = load3(intrinsics, 3 * view)
    _, fy, cy = load3(intrinsics, 3 * view + 1)
    is_front = z > 0
    x = x / tl.where(is_front, z, 1.0)
    y = y / tl.where(is_front, z, 1.0)
    u = fx * x + skew * y + cx
    v = fy * y + cy
    can_see = is_front & (u >= 0) & (u <= width) & (v >= 0) & (v <= height)
    left, right, before, after = cells(u, width)
    top, bottom, above, below = cells(v, height)
    top = top * width
    bottom = bottom * width
    area = height * width
    row = out + i * CHANNELS
    for k in tl.static_range(3):
        plane = (3 * view + k) * area
        color = between(photo + plane, top, bottom, left, right, above, below, before, after)
        shown = between(drawn + plane, top, bottom, left, right, above, below, before, after)
        tl.store(row + k, tl.where(can_see, color - tl.load(colors + 3 * gaussian + k), 0.0))
        tl.store(row + 3 + k, tl.where(can_see, color - shown, 0.0))
    plane = view * area
    share = between(mask + plane, top, bottom, left, right, above, below, before, after)
    opacity = between(alpha + plane, top, bottom, left, right, above, below, before, after)
    surface = between(depth + plane, top, bottom, left, right, above, below, before, after)
    tl.store(row + 6, tl.where(can_see, share, 0.0))
    tl.store(row + 7, tl.where(can_see, opacity, 0.0))
    tl.store(row + 8, tl.where(can_see, tanh((z - surface) / scale), 0.0))
    tl.store(row + 9, can_see.to(tl.float32))
    tl.store(row + 10, (turn == 0).to(tl.float32))


def observe(*inputs) -> Tensor:
    """Kernel of the operator of :mod:`ghgs_lit.ops.observation`."""
    *tensors, scale, _ = inputs
    means = tensors[0]
    photo = tensors[5]
    views, _, height, width = photo.shape[1:]
    out = means.new_empty(len(means), views, CHANNELS.value)
    start(observe_rows, len(means) * views, *tensors, out, views, height, width, scale)
    return out
