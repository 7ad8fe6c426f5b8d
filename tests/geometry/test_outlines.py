"""Distances to the outlines of masks."""

import numpy as np
import pytest
from scipy.spatial.distance import cdist

from ghgs_lit.geometry.outlines import signed_distance


def test_the_outline_runs_half_way_between_pixels():
    """Distances are those to the nearest pixel on the other side, found by going through all pairs."""
    mask = np.random.default_rng(0).uniform(size=(14, 11)) < 0.5
    places = np.argwhere(np.ones_like(mask))
    apart = cdist(places, places)
    apart[mask.ravel()[:, None] == mask.ravel()] = np.inf
    expected = (apart.min(1).reshape(mask.shape) - 0.5) * np.where(mask, 1, -1)
    np.testing.assert_allclose(signed_distance(mask), expected, atol=1e-6)


@pytest.mark.parametrize("value", [False, True])
def test_without_an_outline_all_is_infinitely_far(value):
    assert (signed_distance(np.full((3, 4), value)) == (np.inf if value else -np.inf)).all()
