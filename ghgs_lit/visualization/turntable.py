"""Cameras on a circle around the subject, and the position of the subject of given cameras."""

import math

import torch
from torch import Tensor

from ghgs_lit.geometry.projection import look_at_point, project
from ghgs_lit.types import Cameras, Gaussians

_OPAQUE = 0.5  #: Least opacity of Gaussians that represent the subject
_OUTSIDE = 1e-3  #: Fraction of them (floaters) clipped at each face of the subject's box
_SHARE = 0.95  #: Largest fraction of a picture's height and width that the subject fills


def subject_points(gaussians: Gaussians) -> Tensor:
    """Centres [n, 3] of one subject's opaque Gaussians (all, if none is opaque) without outliers, in
    float64 and the world's unit."""
    opaque = gaussians.opacities >= _OPAQUE
    points = (gaussians.means[opaque] if bool(opaque.any()) else gaussians.means).detach().double()
    if not len(points):
        return points
    ordered = points.sort(0).values
    last = len(points) - 1
    low = ordered[round(_OUTSIDE * last)]
    high = ordered[round((1 - _OUTSIDE) * last)]
    return points[((points >= low) & (points <= high)).all(1)]


def center_of(points: Tensor, cameras: Cameras) -> Tensor:
    """Centre [3] of the bounding box of points [n, 3], in float64; without points, where the optical
    axes of the V cameras meet."""
    return (points.amin(0) + points.amax(0)) / 2 if len(points) else look_at_point(cameras)


def pixel_size(cameras: Cameras, center: Tensor) -> float:
    """Size of a pixel at the subject's ``center`` [3] in the world's unit, mean over V cameras."""
    depths = ((center - cameras.centers) * cameras.extrinsics[:, 2, :3].double()).sum(-1)
    return float((depths / cameras.intrinsics[:, 0, 0]).mean())


def up_direction(cameras: Cameras) -> Tensor:
    """Estimate the up direction from V upright cameras: a unit vector [3] in the world, float64.

    Upright cameras may look up or down, but the rows of their images are level: up is perpendicular
    to all rows and, among such directions, nearest to the mean upward column. A world axis within 3
    degrees of it is returned instead, so that small tilts of the cameras do not tilt an upright world.
    """
    rows = cameras.extrinsics[:, 0, :3].double()
    columns = cameras.extrinsics[:, 1, :3].double()
    mean = -columns.mean(0)
    # Least squares; the small weight of the mean decides if all image rows are parallel.
    weight = 1e-3 * len(rows)
    level = rows.mT @ rows + weight * torch.eye(3, dtype=rows.dtype, device=rows.device)
    up = torch.nn.functional.normalize(torch.linalg.solve(level, weight * mean), dim=0)
    axis = int(up.abs().argmax())
    if up[axis].abs() > math.cos(math.radians(3)):
        up = torch.zeros_like(up).index_fill(0, torch.tensor(axis, device=up.device), float(up[axis].sign()))
    return up


def turntable(cameras: Cameras, frames: int, points: Tensor | None = None) -> Cameras:
    """Cameras on a full circle around the subject, at the mean distance and height of the given ones.

    The circle starts at the first camera's side, with its intrinsics. With points of the subject,
    cameras circle the centre of the points' box, look straight at it, and have a wider field of view
    if the first camera's would cut points off. Without, they circle the point where the optical axes
    meet.

    Args:
        cameras: V cameras.
        frames: number of cameras on the circle.
        points: points of the subject [n, 3], n may be 0; None: unknown.
    """
    angles = torch.arange(frames, dtype=torch.float64) * (2 * math.pi / max(frames, 1))
    return orbit(cameras, angles, points)


def orbit(cameras: Cameras, angles: Tensor, points: Tensor | None = None) -> Cameras:
    """Cameras as in :func:`turntable`, at given angles.

    Args:
        cameras: V cameras.
        angles: angles from the first camera's side [n], float64, in radians.
        points: points of the subject [m, 3], m may be 0; None: unknown.
    """
    center = look_at_point(cameras) if points is None else center_of(points, cameras)
    frames = len(angles)
    angles = angles.to(center.device)
    up = up_direction(cameras)
    offsets = cameras.centers.double() - center
    heights = offsets @ up
    flat = offsets - heights[:, None] * up
    radius = flat.norm(dim=-1).mean()
    start = torch.nn.functional.normalize(flat[0], dim=0)
    side = torch.linalg.cross(up, start)
    around = angles.cos()[:, None] * start + angles.sin()[:, None] * side
    positions = center + radius * around + heights.mean() * up
    forward = torch.nn.functional.normalize(center - positions, dim=-1)
    right = torch.nn.functional.normalize(torch.linalg.cross(forward, up.expand_as(forward)), dim=-1)
    rotation = torch.stack((right, torch.linalg.cross(forward, right), forward), dim=-2)
    extrinsics = torch.eye(4, dtype=torch.float64, device=center.device).repeat(frames, 1, 1)
    extrinsics[:, :3, :3] = rotation
    extrinsics[:, :3, 3] = -(rotation @ positions[..., None])[..., 0]
    intrinsics = cameras.intrinsics[:1].expand(frames, 3, 3)
    if points is not None and frames:
        intrinsics = _fit_lens(intrinsics, extrinsics, points, cameras.height, cameras.width)
    return Cameras(intrinsics, extrinsics.to(cameras.extrinsics.dtype), cameras.height, cameras.width)


def _fit_lens(intrinsics: Tensor, extrinsics: Tensor, points: Tensor, height: int, width: int) -> Tensor:
    """Centre the principal point, and shorten focal lengths until all points are in the frame."""
    middle = intrinsics.new_tensor([width / 2, height / 2])
    intrinsics = intrinsics.clone()
    intrinsics[:, :2, 2] = middle
    if not len(points):
        return intrinsics
    shape = (len(intrinsics), len(points))
    pixels, depth = project(
        points.expand(*shape, 3),
        intrinsics.double()[:, None].expand(*shape, 3, 3),
        extrinsics[:, None].expand(*shape, 4, 4),
    )
    reach = ((pixels - middle).abs() / middle)[depth > 0].amax()
    intrinsics[:, :2, :2] *= (_SHARE / reach).clamp(max=1).to(intrinsics)
    return intrinsics
