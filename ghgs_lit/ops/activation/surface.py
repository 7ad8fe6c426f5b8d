"""Local axes of the surface of a depth map."""

from math import inf

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from ghgs_lit.geometry.projection import at_least_float32
from ghgs_lit.geometry.rotations import matrix_to_quaternion, multiply_quaternions, unit
from ghgs_lit.types import Cameras, DepthMaps

#: A neighbour counts fully if its depth differs by less than the first number of pixel footprints,
#: and not at all (another surface) from the second on.
SAME = 4.0
OTHER = 8.0


@torch.no_grad()
def surface_axes(
    maps: DepthMaps, cameras: Cameras, image: Int[Tensor, " N"], pixel: Int[Tensor, " N"]
) -> Float[Tensor, "N 4"]:
    """Unit quaternions from axes of the surface to the world, without a gradient.

    The third axis is the normal away from the camera; the others are the camera's right and down,
    turned by the smallest rotation from its forward axis to the normal. Normals come from depth
    differences to neighbouring valid pixels on the same surface; without any along an axis of the
    image, its slope is 0.

    Args:
        maps: depths in metres, and which of them are valid.
        cameras: [B, V], of the maps.
        image: numbers of the images (``b * V + v``).
        pixel: row-major indices of their pixels.
    """
    height, width = maps.depth.shape[-2:]
    depth = at_least_float32(maps.depth)
    own = depth.flatten(0, 1).flatten(1)[image, pixel]
    intrinsics = at_least_float32(cameras.intrinsics).flatten(0, 1)[image]
    fx, skew, cx, fy, cy = (intrinsics[:, i, j] for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2)))
    row = pixel // width
    column = pixel % width
    # Invalid pixels and those beyond the border are infinitely far away.
    around = F.pad(depth.masked_fill(~maps.valid, inf), (1, 1, 1, 1), value=inf).flatten()
    place = (image * (height + 2) + row + 1) * (width + 2) + column + 1
    # Of the neighbours to the right, below, to the left and above: how much deeper,
    # and a weight from 0 to 1.
    deeper = around[torch.stack([place + step for step in (1, width + 2, -1, -width - 2)])] - own
    near = ((OTHER - deeper.abs() / (own / fx)) / (OTHER - SAME)).clamp(0, 1)
    after, before = (near * torch.where(near > 0, deeper, 0)).split(2)
    # Relative changes of depth from one pixel to the next.
    right, down = (after - before) / ((1 + near[:2] * near[2:]) * own + after + before)
    # The cross product of the tangents d(z K^-1 [u v 1]) / du and / dv, multiplied by fx fy / z^2.
    toward = 1 + right * (column + 0.5 - cx) + down * (row + 0.5 - cy)
    x = -fx * right
    y = -skew * right - fy * down
    length = (x.square() + y.square() + toward.square()).sqrt()
    turn = unit(torch.stack((length + toward, -y, x, torch.zeros_like(x)), -1))
    extrinsics = at_least_float32(cameras.extrinsics).flatten(0, 1)
    return multiply_quaternions(matrix_to_quaternion(extrinsics[:, :3, :3].mT)[image], turn)
