"""Local axes of the surface that a depth map describes."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ghgs_lit.geometry.projection import at_least_float32
from ghgs_lit.geometry.rotations import matrix_to_quaternion, multiply_quaternions
from ghgs_lit.geometry.vectors import unit
from ghgs_lit.types import Cameras, DepthMaps

#: A neighbour counts fully where its depth differs by less of a pixel's footprints than the first number, and
#: from the second on it lies on another surface.
_SAME, _OTHER = 4.0, 8.0


@torch.no_grad()
def surface_axes(
    maps: DepthMaps, cameras: Cameras, image: Int[Tensor, " N"], pixel: Int[Tensor, " N"]
) -> Float[Tensor, "N 4"]:
    """Unit quaternions from axes of the surface to the world, without a gradient.

    The third axis is the normal, away from the camera; the others are the camera's right and down, turned by
    the smallest rotation that brings its forward axis there. Normals come from differences of the depths of
    neighbouring valid pixels on the same surface; an axis of the image along which there is none is level.

    Args:
        maps: depths of the images.
        cameras: theirs.
        image, pixel: which pixels (``b * V + v``, row-major index).
    """
    height, width = maps.depth.shape[-2:]
    depth, valid = at_least_float32(maps.depth).flatten(), maps.valid.flatten()
    intrinsics = at_least_float32(cameras.intrinsics).flatten(0, 1)
    fx, skew, cx, fy, cy = (intrinsics[:, i, j][image] for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2)))
    row, column = pixel // width, pixel % width
    place = image * (height * width) + pixel
    own = depth[place]
    footprint = own / fx

    def neighbor(step: int, inside: Bool[Tensor, " N"]) -> tuple[Float[Tensor, " N"], Float[Tensor, " N"]]:
        """A neighbour's depth, and how far it lies on the same surface, 0 to 1."""
        other = torch.where(inside, place + step, place)
        exists = inside & valid[other]
        z = torch.where(exists, depth[other], own)
        distance = (z - own).abs() / footprint
        return z, ((_OTHER - distance) / (_OTHER - _SAME)).clamp(0, 1) * exists

    def slope(
        step: int, has_after: Bool[Tensor, " N"], has_before: Bool[Tensor, " N"]
    ) -> Float[Tensor, " N"]:
        """By which share depth grows from one pixel to the next."""
        (after, near_after), (before, near_before) = neighbor(step, has_after), neighbor(-step, has_before)
        growth = near_after * (after - own) + near_before * (own - before)
        base = near_after * after + near_before * before + (1 - near_after) * (1 - near_before) * own
        return growth / base

    right, down = slope(1, column < width - 1, column > 0), slope(width, row < height - 1, row > 0)
    # The cross product of the tangents d(z K^-1 [u v 1]) / du and / dv, multiplied by fx fy / z^2.
    toward = 1 + right * (column + 0.5 - cx) + down * (row + 0.5 - cy)
    x, y = -fx * right, -skew * right - fy * down
    length = (x.square() + y.square() + toward.square()).sqrt()
    turn = unit(torch.stack((length + toward, -y, x, torch.zeros_like(x)), -1))
    extrinsics = at_least_float32(cameras.extrinsics).flatten(0, 1)
    return multiply_quaternions(matrix_to_quaternion(extrinsics[:, :3, :3].mT)[image], turn)
