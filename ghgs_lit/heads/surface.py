"""Local axes of the surface that a depth map describes."""

from math import inf

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from ghgs_lit.geometry.projection import at_least_float32
from ghgs_lit.geometry.rotations import matrix_to_quaternion, multiply_quaternions, unit
from ghgs_lit.types import Cameras, DepthMaps

#: A neighbour counts fully where its depth differs by less of a pixel's footprints than the first number, and
#: from the second on it lies on another surface.
SAME, OTHER = 4.0, 8.0


@torch.no_grad()
def surface_axes(
    maps: DepthMaps, cameras: Cameras, image: Int[Tensor, " N"], pixel: Int[Tensor, " N"]
) -> Float[Tensor, "N 4"]:
    """Unit quaternions from axes of the surface to the world, without a gradient.

    The third axis is the normal, away from the camera; the others are the camera's right and down, turned by
    the smallest rotation that brings its forward axis there. Normals come from differences of the depths of
    neighbouring valid pixels on the same surface; an axis of the image along which there is none is level.
    ``image``, ``pixel``: numbers of the images (``b * V + v``) and row-major indices of their pixels.
    """
    height, width = maps.depth.shape[-2:]
    depth = at_least_float32(maps.depth)
    own = depth.flatten(0, 1).flatten(1)[image, pixel]
    intrinsics = at_least_float32(cameras.intrinsics).flatten(0, 1)
    fx, skew, cx, fy, cy = (intrinsics[:, i, j][image] for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2)))
    row, column = pixel // width, pixel % width
    # A pixel that is not valid, or beyond the border, is infinitely far away.
    around = F.pad(depth.masked_fill(~maps.valid, inf), (1, 1, 1, 1), value=inf).flatten()
    place = (image * (height + 2) + row + 1) * (width + 2) + column + 1
    footprint = own / fx

    def neighbor(step: int) -> tuple[Float[Tensor, " N"], Float[Tensor, " N"]]:
        """Depth of a neighbour less the pixel's (0 off its surface), and whether it is on it, 0 to 1."""
        deeper = around[place + step] - own
        near = ((OTHER - deeper.abs() / footprint) / (OTHER - SAME)).clamp(0, 1)
        return near * torch.where(near > 0, deeper, 0), near

    def slope(step: int) -> Float[Tensor, " N"]:
        """Relative change of depth from one pixel to the next."""
        (after, near_after), (before, near_before) = neighbor(step), neighbor(-step)
        return (after - before) / ((1 + near_after * near_before) * own + after + before)

    right, down = slope(1), slope(width + 2)
    # The cross product of the tangents d(z K^-1 [u v 1]) / du and / dv, multiplied by fx fy / z^2.
    toward = 1 + right * (column + 0.5 - cx) + down * (row + 0.5 - cy)
    x, y = -fx * right, -skew * right - fy * down
    length = (x.square() + y.square() + toward.square()).sqrt()
    turn = unit(torch.stack((length + toward, -y, x, torch.zeros_like(x)), -1))
    extrinsics = at_least_float32(cameras.extrinsics).flatten(0, 1)
    return multiply_quaternions(matrix_to_quaternion(extrinsics[:, :3, :3].mT)[image], turn)
