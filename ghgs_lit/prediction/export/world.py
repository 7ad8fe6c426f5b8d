"""The frame that files are written in: the cameras' world, or one whose up is an axis."""

import dataclasses

import torch
from jaxtyping import Float
from torch import Tensor

from ghgs_lit.geometry.rotations import multiply_quaternions, quaternion_to_matrix
from ghgs_lit.types import Cameras, Gaussians

AXES = {"y": (0.0, 1.0, 0.0), "-y": (0.0, -1.0, 0.0), "z": (0.0, 0.0, 1.0)}


def turn(start: Float[Tensor, "3"], end: Float[Tensor, "3"]) -> Float[Tensor, "4"]:
    """The unit quaternion of the shortest rotation from unit vector ``start`` to ``end``, float64."""
    start, end = start.double(), end.double()
    axis = torch.linalg.cross(start, end)
    quaternion = torch.cat([(1 + start @ end)[None], axis])
    if quaternion.norm() < 1e-7:  # opposite: half a turn about any axis at right angles
        other = torch.zeros_like(start).index_fill(0, start.abs().argmin(), 1)
        quaternion = torch.cat([start.new_zeros(1), torch.linalg.cross(start, other)])
    return torch.nn.functional.normalize(quaternion, dim=0)


def rotate_world(
    quaternion: Float[Tensor, "4"], gaussians: Gaussians, cameras: Cameras
) -> tuple[Gaussians, Cameras]:
    """The same scene in a world rotated by the unit ``quaternion``: every image stays as it is.

    Colours must not depend on the direction.
    """
    quaternion = quaternion.double()
    rotation = quaternion_to_matrix(quaternion)
    means = gaussians.means.double() @ rotation.to(gaussians.means.device).mT
    quaternions = multiply_quaternions(quaternion.to(means.device), gaussians.quaternions.double())
    extrinsics = cameras.extrinsics.double().clone()
    extrinsics[..., :3, :3] = extrinsics[..., :3, :3] @ rotation.to(extrinsics.device).mT
    return (
        dataclasses.replace(
            gaussians,
            means=means.to(gaussians.means.dtype),
            quaternions=quaternions.to(gaussians.quaternions.dtype),
        ),
        dataclasses.replace(cameras, extrinsics=extrinsics.to(cameras.extrinsics.dtype)),
    )
