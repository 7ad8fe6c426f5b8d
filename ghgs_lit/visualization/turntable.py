"""Cameras on a circle around the subject of given cameras."""

import math

import torch
from torch import Tensor

from ghgs_lit.types import Cameras


def look_at_point(cameras: Cameras) -> Tensor:
    """The world point [3] nearest to all optical axes of ``cameras`` [V] (least squares), float64.

    Where the axes are parallel, the one of these points nearest to the mean position of the cameras.
    """
    forward, centers = cameras.extrinsics[:, 2, :3].double(), cameras.centers.double()
    middle = centers.mean(0)
    away = torch.eye(3, dtype=torch.float64, device=forward.device) - forward[:, :, None] * forward[:, None]
    right = (away @ (centers - middle)[:, :, None]).sum(0)
    return middle + (torch.linalg.pinv(away.sum(0), rtol=1e-6) @ right)[:, 0]


def turntable(cameras: Cameras, frames: int) -> Cameras:
    """Cameras on one turn around the subject, at the mean distance and height of the given ones.

    They begin at the side of the first camera and have its intrinsics; up is the mean of all cameras.

    Args:
        cameras: the given cameras [V].
        frames: the number of cameras.
    """
    center = look_at_point(cameras)
    up = torch.nn.functional.normalize(-cameras.extrinsics[:, 1, :3].double().mean(0), dim=0)
    offsets = cameras.centers.double() - center
    heights = offsets @ up
    flat = offsets - heights[:, None] * up
    radius = flat.norm(dim=-1).mean()
    start = torch.nn.functional.normalize(flat[0], dim=0)
    side = torch.linalg.cross(up, start)
    angles = torch.arange(frames, dtype=torch.float64, device=center.device) * (2 * math.pi / max(frames, 1))
    around = angles.cos()[:, None] * start + angles.sin()[:, None] * side
    positions = center + radius * around + heights.mean() * up
    forward = torch.nn.functional.normalize(center - positions, dim=-1)
    right = torch.nn.functional.normalize(torch.linalg.cross(forward, up.expand_as(forward)), dim=-1)
    rotation = torch.stack((right, torch.linalg.cross(forward, right), forward), dim=-2)
    extrinsics = torch.eye(4, dtype=torch.float64, device=center.device).repeat(frames, 1, 1)
    extrinsics[:, :3, :3] = rotation
    extrinsics[:, :3, 3] = -(rotation @ positions[..., None])[..., 0]
    intrinsics = cameras.intrinsics[:1].expand(frames, 3, 3)
    return Cameras(intrinsics, extrinsics.to(cameras.extrinsics.dtype), cameras.height, cameras.width)
