"""Cameras on a circle around the subject of given cameras."""

import math

import torch
from torch import Tensor

from ghgs_lit.geometry.projection import look_at_point
from ghgs_lit.types import Cameras


def pixel_size(cameras: Cameras) -> float:
    """The side of a photograph's pixel at the subject, mean of ``cameras`` [V]."""
    away = look_at_point(cameras) - cameras.centers
    depths = (away * cameras.extrinsics[:, 2, :3].double()).sum(-1)
    return float((depths / cameras.intrinsics[:, 0, 0]).mean())


def up_direction(cameras: Cameras) -> Tensor:
    """The world's unit vector [3] that is up in the photographs of ``cameras`` [V], float64.

    Cameras that are held upright may look up or down, but the rows of their images are level: up is at right
    angles to all of them, and nearest to the mean upward column. An axis of the world within 3 degrees is
    taken as it is, so that small tilts of the cameras do not tilt a world that is upright.
    """
    rows, columns = cameras.extrinsics[:, 0, :3].double(), cameras.extrinsics[:, 1, :3].double()
    mean = -columns.mean(0)
    # Least squares; the small weight of the mean decides where all rows of images are parallel.
    weight = 1e-3 * len(rows)
    level = rows.mT @ rows + weight * torch.eye(3, dtype=rows.dtype, device=rows.device)
    up = torch.nn.functional.normalize(torch.linalg.solve(level, weight * mean), dim=0)
    axis = int(up.abs().argmax())
    if up[axis].abs() > math.cos(math.radians(3)):
        up = torch.zeros_like(up).index_fill(0, torch.tensor(axis, device=up.device), float(up[axis].sign()))
    return up


def turntable(cameras: Cameras, frames: int) -> Cameras:
    """Cameras on one turn around the subject, at the mean distance and height of the given ones.

    They begin at the side of the first camera and have its intrinsics.

    Args:
        cameras: the given cameras [V].
        frames: the number of cameras.
    """
    center = look_at_point(cameras)
    up = up_direction(cameras)
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
