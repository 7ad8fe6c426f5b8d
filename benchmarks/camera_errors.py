"""Calibration errors of some pixels, for measurements."""

import dataclasses
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ghgs_lit.errors import require
from ghgs_lit.extents import extents
from ghgs_lit.geometry.projection import look_at_point, project, unproject
from ghgs_lit.geometry.rotations import (
    apply_motions,
    motions_between,
    quaternion_to_matrix,
    remove_common_motion,
)
from ghgs_lit.types import Batch, Cameras


def add_camera_errors(batch: Batch, pixels: float, rngs: Sequence[np.random.Generator]) -> Batch:
    """Add calibration errors to the input cameras of a batch; targets keep theirs.

    Args:
        pixels: maximum error in pixels, above 0.
        rngs: generator of each element.
    """
    wrong = [
        perturb_cameras(batch.cameras[b], batch.masks[b], pixels, rng.spawn(2)[1])
        for b, rng in enumerate(rngs)
    ]
    matrices = zip(*((one.intrinsics, one.extrinsics) for one in wrong), strict=True)
    cameras = Cameras(*map(torch.stack, matrices), batch.cameras.height, batch.cameras.width)
    return dataclasses.replace(batch, cameras=cameras)


def perturb_cameras(
    cameras: Cameras, masks: Bool[Tensor, "V H W"], pixels: float, rng: np.random.Generator
) -> Cameras:
    """Add calibration errors to cameras: a rotation, a translation across the axis, and a change of the
    focal length.

    A camera's error, at most ``pixels``, is the root mean square motion of the corners of its mask's
    box (of the image for an empty mask) at the subject's distance. The common error of all cameras is
    removed, because images show only differences between cameras.

    Args:
        cameras: true cameras [V].
        pixels: maximum error in pixels, above 0.

    Returns:
        Cameras [V] of the same sizes and dtypes.

    Raises:
        InputError: the point that the cameras look at is not in front of all of them.
    """
    count = len(masks)
    directions = torch.from_numpy(rng.standard_normal((count, 6)))
    wanted = pixels * torch.from_numpy(rng.uniform(size=count))
    lenses = cameras.intrinsics.double()
    poses = cameras.extrinsics.double()
    distances = (poses[:, 2, :3] * look_at_point(cameras)).sum(-1) + poses[:, 2, 3]
    expected = "cameras that look at the subject"
    require(bool((distances > 0).all()), "cameras", expected, distances.tolist())
    corners = _corners(masks)

    def perturb(errors: Tensor) -> tuple[Tensor, Tensor]:
        """Intrinsics and extrinsics with errors [V, 6], which are approximately in pixels."""
        focal = lenses[:, 1, 1]
        half = max(cameras.height, cameras.width) / 2
        turn = errors[:, :3] / 2 / torch.stack((focal, focal, torch.full_like(focal, half)), -1)
        rotation = quaternion_to_matrix(torch.cat((torch.ones(count, 1, dtype=turn.dtype), turn), -1))
        pose = poses.clone()
        lens = lenses.clone()
        pose[:, :3] = rotation @ poses[:, :3]
        pose[:, :2, 3] += errors[:, 3:5] * (distances / focal)[:, None]
        lens[:, [0, 1], [0, 1]] *= 1 + errors[:, 5:] / half
        return lens, pose

    points = unproject(
        corners, distances[:, None].expand(-1, 4), _repeat_for_corners(lenses), _repeat_for_corners(poses)
    )

    # Far from the world's origin these differ from ``corners`` by rounding.
    true = project(points, _repeat_for_corners(lenses), _repeat_for_corners(poses))[0]

    def measure_error(lens: Tensor, pose: Tensor) -> Tensor:
        moved = project(points, _repeat_for_corners(lens), _repeat_for_corners(pose))[0]
        return (moved - true).square().sum(-1).mean(-1).sqrt()

    errors = wanted[:, None] * directions / directions.norm(dim=-1, keepdim=True)
    for _ in range(3):  # converges fast, as the size is nearly proportional to the errors
        errors = errors * (wanted / measure_error(*perturb(errors)))[:, None]
    lens, pose = _remove_common_error(cameras, *perturb(errors))
    largest = measure_error(lens, pose).amax()
    if largest > pixels:
        lens, pose = _remove_common_error(cameras, *perturb(errors * (pixels / largest)))
    return Cameras(lens.to(cameras.intrinsics), pose.to(cameras.extrinsics), cameras.height, cameras.width)


def _corners(masks: Bool[Tensor, "V H W"]) -> Float[Tensor, "V 4 2"]:
    """Corners of the boxes around masks in pixels; those of the image for an empty mask."""
    masks = torch.where(masks.any((1, 2), keepdim=True), masks, True)
    boxes = [([one.left, one.right], [one.top, one.bottom]) for one in extents(masks)]
    return torch.stack([torch.cartesian_prod(*map(torch.tensor, box)) for box in boxes]).double()


def _repeat_for_corners(matrices: Float[Tensor, "V n m"]) -> Float[Tensor, "V 4 n m"]:
    return matrices[:, None].expand(-1, 4, -1, -1)


def _remove_common_error(
    cameras: Cameras, lens: Float[Tensor, "V 3 3"], pose: Float[Tensor, "V 4 4"]
) -> tuple[Float[Tensor, "V 3 3"], Float[Tensor, "V 4 4"]]:
    """Remove the common part of the errors of cameras; returns float64 intrinsics and extrinsics."""
    true = cameras.extrinsics.double()
    middle = look_at_point(cameras).double()
    motions = remove_common_motion(motions_between(true, pose, middle), true[:, 2, :3])
    both = [0, 1]
    zoom = lens[:, both, both] / cameras.intrinsics.double()[:, both, both]
    lens = lens.clone()
    lens[:, both, both] /= zoom.mean(0)
    return lens, apply_motions(true, motions, middle)
