"""Imperfections of captures: their limits in stops and pixels, measured independently."""

import numpy as np
import pytest
import torch
from scipy.ndimage import binary_dilation, binary_erosion, zoom

from ghgs_lit.data.imperfections import perturb_cameras, perturb_mask, sample_backgrounds, sample_color_gains
from ghgs_lit.errors import InputError
from ghgs_lit.geometry.projection import project
from ghgs_lit.types import Cameras
from ghgs_people.rig import Rig


def figure(height=96, width=72) -> np.ndarray:
    """Mask of a body with outstretched arms."""
    mask = np.zeros((height, width), bool)
    mask[10:85, 28:44] = True
    mask[25:33, 8:64] = True
    return mask


def disc(radius: float) -> np.ndarray:
    reach = np.arange(-int(radius), int(radius) + 1)
    return reach[:, None] ** 2 + reach**2 <= radius**2


def test_gains_stay_within_their_stops_and_change_nothing_on_average():
    """Deviations stay within their limits in stops (a stop doubles the light, and stored values are light to
    the power 1/2.2), with a mean of 0."""
    largest = np.zeros(3)
    for seed in range(40):
        gains = sample_color_gains(4, 0.5, 0.2, np.random.default_rng(seed))
        stops = 2.2 * np.log2(gains)
        np.testing.assert_allclose(stops.mean(0), 0, atol=1e-9)
        tint = stops - stops[:, [1]]
        found = np.abs(np.stack((stops[:, 1], tint[:, 0], tint[:, 2]))).max(1)
        assert (found <= np.array([0.5, 0.2, 0.2]) + 1e-9).all()
        largest = np.maximum(largest, found)
    assert (largest > 0.9 * np.array([0.5, 0.2, 0.2])).all()


def test_masks_grow_shrink_and_fray_within_their_pixels():
    """Masks change up to the limit from the outline, but not beyond."""
    mask = figure()
    most = {"grown": 0, "shrunk": 0}
    both = 0
    for seed in range(12):
        for offset, ragged in ((3, 0), (0, 3), (1.5, 1.5)):
            found = perturb_mask(mask, offset, ragged, 0, 0, np.random.default_rng(seed))
            # The outline lies half a pixel from the centres of its pixels.
            assert not (found & ~binary_dilation(mask, disc(3.5))).any()
            assert not (binary_erosion(mask, disc(3.5)) & ~found).any()
            grown, shrunk = (found & ~mask).sum(), (mask & ~found).sum()
            if ragged == 0:
                assert grown == 0 or shrunk == 0
                most = {"grown": max(most["grown"], grown), "shrunk": max(most["shrunk"], shrunk)}
            both += bool(grown and shrunk)
    outline = (mask & ~binary_erosion(mask)).sum()
    assert min(most.values()) > 1.5 * outline
    assert both > 6


@pytest.mark.parametrize("size", [(60, 45), (31, 50)])
def test_backgrounds_are_patches_that_scipy_enlarges(size):
    """Patterns equal those of SciPy's interpolation from the same random numbers, within float32 rounding."""
    found = sample_backgrounds(2, *size, np.random.default_rng(4))
    rng = np.random.default_rng(4)
    expected = 0.5 + rng.uniform(-0.2, 0.2, (2, 3, 1, 1)) + 0.02 * rng.standard_normal((2, 3, *size))
    for cells, deviation in ((3, 0.35), (12, 0.15), (40, 0.06)):
        patches = rng.uniform(-deviation, deviation, (2, 3, cells, cells))
        expected += zoom(patches, (1, 1, size[0] / cells, size[1] / cells), order=1)
    np.testing.assert_allclose(found, expected.clip(0, 1), rtol=0, atol=2e-6)


def test_a_missing_piece_is_round_and_not_larger_than_its_share():
    """The missing piece fits into a circle of the limit's diameter and occurs with the given probability."""
    mask, missing = figure(), 0
    for seed in range(60):
        found = perturb_mask(mask, 0, 0, 0.2, 0.5, np.random.default_rng(seed))
        gone = np.argwhere(mask & ~found)
        assert not (found & ~mask).any()
        missing += len(gone) > 0
        if len(gone):
            distances = np.linalg.norm(gone[:, None] - gone, axis=-1)
            assert distances.max() <= 0.2 * 75
    assert 15 < missing < 40
    np.testing.assert_array_equal(perturb_mask(mask, 0, 0, 0.2, 0, np.random.default_rng(0)), mask)


@pytest.mark.parametrize("mask", [np.eye(1, 30, 7, bool).repeat(20, 0), np.ones((14, 28), bool)])
def test_no_mask_is_emptied(mask):
    """Neither a line one pixel wide nor a subject that fills the image becomes empty."""
    for seed in range(20):
        assert perturb_mask(mask, 4, 4, 3.0, 1.0, np.random.default_rng(seed)).any()


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
    assert not perturb_mask(masks[1].numpy(), 2, 2, 0.2, 1.0, np.random.default_rng(0)).any()


def test_cameras_that_look_away_from_one_another_are_refused():
    """Cameras that do not look at a common subject are rejected, as an error in pixels is undefined."""
    cameras, masks, _ = ring()
    turned = cameras.extrinsics.clone()
    turned[:, [0, 2]] *= -1  # by half a turn
    with pytest.raises(InputError, match=r"augmentation\.calibration: expected cameras that look at"):
        perturb_cameras(Cameras(cameras.intrinsics, turned, 96, 72), masks, 1.0, np.random.default_rng(0))
