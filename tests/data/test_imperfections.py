"""Imperfections of captures: their limits in stops and pixels, measured independently."""

import numpy as np
import pytest
from scipy.ndimage import binary_dilation, binary_erosion, zoom

from ghgs_lit.data.imperfections import perturb_mask, sample_backgrounds, sample_color_gains


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
    """Neither a line one pixel wide nor a subject that fills the image becomes empty; an empty one stays."""
    assert not perturb_mask(0 * mask, 2, 2, 0.2, 1.0, np.random.default_rng(0)).any()
    for seed in range(20):
        assert perturb_mask(mask, 4, 4, 3.0, 1.0, np.random.default_rng(seed)).any()
