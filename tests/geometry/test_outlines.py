"""Distances to the outlines of masks."""

import numpy as np
import pytest
from scipy.spatial.distance import cdist

from ghgs_lit.geometry.masks import signed_distance, soft_signed_distance


def test_the_outline_runs_half_way_between_pixels():
    """Distances are those to the nearest pixel on the other side,
    found by going through all pairs."""
    mask = np.random.default_rng(0).uniform(size=(14, 11)) < 0.5
    places = np.argwhere(np.ones_like(mask))
    apart = cdist(places, places)
    apart[mask.ravel()[:, None] == mask.ravel()] = np.inf
    expected = (apart.min(1).reshape(mask.shape) - 0.5) * np.where(mask, 1, -1)
    np.testing.assert_allclose(signed_distance(mask), expected, atol=1e-6)


@pytest.mark.parametrize("value", [False, True])
def test_without_an_outline_all_is_infinitely_far(value):
    assert (signed_distance(np.full((3, 4), value)) == (np.inf if value else -np.inf)).all()


def test_soft_outlines_are_found_to_fractions_of_a_pixel():
    """Of a disc, from the shares of its pixels;
    where it is cut off straight there is no soft pixel."""
    fine = np.hypot(*((np.indices((320, 320)) + 0.5) / 8 - 20.3)) < 12.4
    matte = fine.reshape(40, 8, 40, 8).mean((1, 3))
    expected = 12.4 - np.hypot(*(np.indices((40, 40)) + 0.5 - 20.3))
    soft, hard = (
        np.abs(found - expected) for found in (soft_signed_distance(matte), signed_distance(matte > 0.5))
    )
    near = np.abs(expected) < 4
    assert soft[near].max() < 0.6
    assert soft[near].mean() < 0.55 * hard[near].mean()
    cut = np.where(np.arange(40) < 20, matte, 0)
    np.testing.assert_allclose(soft_signed_distance(cut)[20, 14:26], 19.5 - np.arange(14, 26), atol=1e-6)
    assert (soft_signed_distance((matte > 0.5) * 1.0) == signed_distance(matte > 0.5)).all()
