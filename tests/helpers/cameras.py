"""Cameras on a circle, for all tests."""

import math

import torch
import torch.nn.functional as F

from ghgs_lit.types import Cameras


def camera_ring(
    views: int,
    height: int,
    width: int,
    batch: int = 1,
    focal: tuple[float, float] | None = None,
    principal: tuple[float, float] | None = None,
    radius: float = 2.0,
    center: tuple[float, float, float] = (0.0, 0.0, 0.0),
    raised: float = 0.0,
    start: float = 0.0,
    spread: float = 360.0,
    turn: float = 0.0,
    up: float = 1.0,
) -> Cameras:
    """Cameras [batch, views] around the y axis that look at ``center``.

    Args:
        views, height, width, batch: number and image size of the cameras.
        focal: focal lengths along x and y in pixels; None: the width.
        principal: principal point in pixels; None: the middle of the image.
        radius: of the circle, in metres.
        center: of the circle, in metres.
        raised: height of the circle above the center along y, in metres.
        start: angle of the first camera, in degrees.
        spread: angle of the whole ring, in degrees.
        turn: rotation of each element against the previous one, in degrees.
        up: 1 where the world's y points up, -1 where it points down.
    """
    # Float64 and rounding make distances and right angles exact in float32.
    middle = torch.tensor(center).double()
    extrinsics = torch.eye(4).repeat(batch, views, 1, 1)
    for b in range(batch):
        for v in range(views):
            angle = math.radians(start + spread * v / views + turn * b)
            eye = middle + middle.new_tensor([radius * math.sin(angle), raised, radius * math.cos(angle)])
            forward = F.normalize(middle - eye, dim=0)
            right = F.normalize(torch.linalg.cross(forward, middle.new_tensor([0.0, up, 0.0])), dim=0)
            rotation = torch.stack((right, torch.linalg.cross(forward, right), forward)).round(decimals=12)
            extrinsics[b, v, :3, :3], extrinsics[b, v, :3, 3] = rotation, (-rotation @ eye).round(decimals=12)
    fx, fy = focal or (width, width)
    cx, cy = principal or (width / 2, height / 2)
    intrinsics = torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    return Cameras(intrinsics.repeat(batch, views, 1, 1), extrinsics, height, width)
