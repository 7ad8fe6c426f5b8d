"""Rays of pixels and what they hit.

A ray is a function of z-depth: ``point(z) = center + z * direction``.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from ghgs_lit.geometry.projection import at_least_float32, inverse_intrinsics, pixel_centers, world_to_camera
from ghgs_lit.types import Cameras, DepthBounds


def ray_directions(cameras: Cameras) -> Float[Tensor, "*batch h w 3"]:
    """World displacement along each pixel's ray per metre of z-depth."""
    intrinsics, extrinsics = at_least_float32(cameras.intrinsics), at_least_float32(cameras.extrinsics)
    centers = pixel_centers(cameras.height, cameras.width, intrinsics)
    centers = torch.cat((centers, torch.ones_like(centers[..., :1])), dim=-1)
    to_world = extrinsics[..., :3, :3].mT @ inverse_intrinsics(intrinsics)
    return torch.einsum("...ij,hwj->...hwi", to_world, centers)


def projection_matrices(cameras: Cameras) -> Float[Tensor, "*batch 3 4"]:
    """``K [R t]``: homogeneous world points to homogeneous pixels."""
    return at_least_float32(cameras.intrinsics) @ at_least_float32(cameras.extrinsics)[..., :3, :]


def pixel_axes(cameras: Cameras) -> tuple[Float[Tensor, " w"], Float[Tensor, " h"]]:
    """Pixel centres along a row and along a column."""
    centers = pixel_centers(cameras.height, cameras.width, at_least_float32(cameras.intrinsics))
    return centers[0, :, 0], centers[:, 0, 1]


def depths_in_box(cameras: Cameras, lower: Float[Tensor, "B 3"], upper: Float[Tensor, "B 3"]) -> DepthBounds:
    """Depths at which the ray of each pixel enters and leaves an axis-aligned box.

    A ray that misses the box gets the range of depths of the whole box. ``lower``: corner of each element's
    box with the smallest coordinates, in metres. ``upper``: corner with the largest coordinates.
    """
    directions = ray_directions(cameras)
    centers = cameras.centers[:, :, None, None]
    # A ray along a face: 1e-12 instead of 0 gives the right infinities without 0 / 0.
    directions = torch.where(directions.abs() < 1e-12, 1e-12, directions)
    faces = [(face[:, None, None, None] - centers) / directions for face in (lower, upper)]
    near = torch.minimum(*faces).amax(-1)
    far = torch.maximum(*faces).amin(-1)
    corners = torch.stack(torch.meshgrid(*[torch.arange(2, device=lower.device)] * 3, indexing="ij"), -1)
    corners = torch.where(corners.reshape(1, 8, 3) == 0, lower[:, None], upper[:, None])
    corners = corners[:, None].expand(-1, cameras.shape[1], -1, -1)
    depth = world_to_camera(corners, cameras.extrinsics[:, :, None])[..., 2]
    misses = near >= far
    return DepthBounds(
        torch.where(misses, depth.amin(-1)[..., None, None], near),
        torch.where(misses, depth.amax(-1)[..., None, None], far),
    )
