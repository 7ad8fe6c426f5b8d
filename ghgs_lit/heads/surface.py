"""Local axes of the surface that a depth map describes."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ghgs_lit.geometry.projection import at_least_float32, unproject
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
    intrinsics = at_least_float32(cameras.intrinsics).flatten(0, 1)[image]
    extrinsics = at_least_float32(cameras.extrinsics).flatten(0, 1)
    row, column = pixel // width, pixel % width
    place = image * (height * width) + pixel
    own = depth[place]
    footprint = own / intrinsics[:, 0, 0]
    identity = torch.eye(4, dtype=own.dtype, device=own.device)

    def point(down: int, right: int) -> tuple[Float[Tensor, "N 3"], Float[Tensor, "N 1"]]:
        """The pixel's neighbour in camera axes, and how far it lies on the same surface, 0 to 1."""
        v, u = row + down, column + right
        inside = (v >= 0) & (v < height) & (u >= 0) & (u < width)
        other = torch.where(inside, place + down * width + right, place)
        step = (depth[other] - own).abs() / footprint
        near = ((_OTHER - step) / (_OTHER - _SAME)).clamp(0, 1) * (inside & valid[other])
        centers = torch.stack((u, v), -1).to(own) + 0.5
        return unproject(centers, depth[other], intrinsics, identity), near[:, None]

    center = point(0, 0)[0]

    def tangent(down: int, right: int) -> Float[Tensor, "N 3"]:
        (after, has_after), (before, has_before) = point(down, right), point(-down, -right)
        level = footprint[:, None] * identity[down, :3]
        return unit(
            has_after * (after - center)
            + has_before * (center - before)
            + (1 - has_after) * (1 - has_before) * level
        )

    x, y, z = unit(torch.linalg.cross(tangent(0, 1), tangent(1, 0))).unbind(-1)
    turn = unit(torch.stack((1 + z, -y, x, torch.zeros_like(z)), -1))
    return multiply_quaternions(matrix_to_quaternion(extrinsics[:, :3, :3].mT)[image], turn)
