"""Calibration errors of measurements: their limits in pixels, measured independently."""

import numpy as np
import pytest
import torch

from benchmarks.camera_errors import perturb_cameras
from ghgs_lit.errors import InputError
from ghgs_lit.geometry.projection import project
from ghgs_lit.types import Cameras
from ghgs_people.rig import Rig


def ring(shift=0.0, dtype=torch.float64) -> tuple[Cameras, torch.Tensor, torch.Tensor]:
    """Four cameras, their masks of an ellipsoid, and points [n, 3] on its surface."""
    cameras = Rig().cameras(np.array([10.0, 80.0, 150.0, 290.0]), 96, 72)
    directions = torch.from_numpy(np.random.default_rng(0).normal(size=(4000, 3)))
    points = directions / directions.norm(dim=-1, keepdim=True) * torch.tensor([0.3, 0.85, 0.25])
    points = points + torch.tensor([0, 0.9, 0])
    masks = torch.zeros(4, 96, 72, dtype=torch.bool)
    for v in range(4):
        pixels, _ = project(points, cameras.intrinsics[v].double(), cameras.extrinsics[v].double())
        columns, rows = pixels.floor().long().unbind(-1)
        masks[v, rows, columns] = True
    extrinsics = cameras.extrinsics.to(dtype).clone()
    # Move the world's origin by (s, s, s).
    extrinsics[:, :3, 3] -= shift * extrinsics[:, :3, :3].sum(-1)
    return Cameras(cameras.intrinsics.to(dtype), extrinsics, 96, 72), masks, points + shift


def measure_motion(found: Cameras, cameras: Cameras, points: torch.Tensor) -> torch.Tensor:
    """Root mean square motion [V] of points in pixels."""
    pixels = [
        [project(points, c.intrinsics[v].double(), c.extrinsics[v].double())[0] for v in range(4)]
        for c in (found, cameras)
    ]
    return (torch.stack(pixels[0]) - torch.stack(pixels[1])).square().sum(-1).mean(-1).sqrt()


@pytest.mark.parametrize("limit", [1.0, 3.0])
def test_calibration_errors_move_the_subject_by_their_pixels(limit):
    """Points of the surface move by up to the limit in each image, and rotations stay proper."""
    cameras, masks, points = ring()
    errors = []
    for seed in range(25):
        found = perturb_cameras(cameras, masks, limit, np.random.default_rng(seed))
        errors.append(measure_motion(found, cameras, points))
        rotation = found.extrinsics[:, :3, :3]
        torch.testing.assert_close(rotation @ rotation.mT, torch.eye(3).double().expand(4, 3, 3))
        assert (found.intrinsics[:, :2, 2] == cameras.intrinsics[:, :2, 2]).all()
    errors = torch.cat(errors) / limit
    assert errors.max() < 1.15  # the limit holds exactly for the corners of the box, not for the surface
    assert errors.max() > 0.7
    assert 0.3 < errors.mean() < 0.6


def test_calibration_errors_have_nothing_in_common():
    """Errors common to all cameras are removed, as images determine neither the place nor the scale of a
    rig."""
    cameras, masks, _ = ring()
    true = cameras.extrinsics
    middle = torch.tensor([0, 0.9, 0]).double()
    for seed in range(10):
        found = perturb_cameras(cameras, masks, 3.0, np.random.default_rng(seed))
        zoom = found.intrinsics[:, 0, 0] / cameras.intrinsics[:, 0, 0]
        assert zoom.std() > 1e-3
        assert abs(zoom.mean() - 1) < 1e-6
        back = true[:, :3, :3].mT
        turn = back @ found.extrinsics[:, :3, :3]
        angles = turn - turn.mT
        assert angles.mean(0).abs().max() < 0.03 * angles.abs().max()
        seen = found.extrinsics[:, :3, :3] @ middle + found.extrinsics[:, :3, 3]
        shift = (back @ (seen - true[:, :3, 3])[..., None])[..., 0] - middle
        along = (shift * true[:, 2, :3]).sum(-1)
        assert along.mean().abs() < 0.1 * along.abs().max()


def test_calibration_errors_do_not_depend_on_the_worlds_origin():
    """Errors are the same if the world's origin is a kilometre away, up to the rounding of rotations."""
    results = []
    for shift in (0.0, 1000.0):
        cameras, masks, points = ring(shift)
        found = perturb_cameras(cameras, masks, 2.0, np.random.default_rng(3))
        results.append(measure_motion(found, cameras, points))
    torch.testing.assert_close(*results, rtol=1e-3, atol=0)


def test_a_photograph_without_the_subject_is_no_obstacle():
    """An empty mask, as small sizes can cause, stays empty, and its camera gets an error like the others."""
    cameras, masks, points = ring()
    masks[1] = False
    found = perturb_cameras(cameras, masks, 2.0, np.random.default_rng(0))
    assert 0 < measure_motion(found, cameras, points)[1] < 2.3


def test_cameras_that_look_away_from_one_another_are_refused():
    """Cameras that do not look at a common subject are rejected, as an error in pixels is undefined."""
    cameras, masks, _ = ring()
    turned = cameras.extrinsics.clone()
    turned[:, [0, 2]] *= -1  # by half a turn
    with pytest.raises(InputError, match="cameras: expected cameras that look at"):
        perturb_cameras(Cameras(cameras.intrinsics, turned, 96, 72), masks, 1.0, np.random.default_rng(0))
