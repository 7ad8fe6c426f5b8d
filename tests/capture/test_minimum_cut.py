"""The minimum cut: the labels of least energy among all, and pixels that are decided without it."""

import itertools

import numpy as np
import pytest
from scipy import ndimage

from ghgs_capture.minimum_cut import NEIGHBOURS, minimum_cut, neighbour_pairs


def value(labels, evidence, costs):
    """What the cut maximises, for labels [..., h, w]."""
    chosen = (labels * evidence).sum((-2, -1))
    for step, cost in zip(NEIGHBOURS, costs, strict=True):
        first, second = neighbour_pairs(np.moveaxis(labels, (-2, -1), (0, 1)), step)
        chosen = chosen - ((first != second) * cost[(...,) + (None,) * (labels.ndim - 2)]).sum((0, 1))
    return chosen


@pytest.mark.parametrize("seed", range(6))
def test_no_other_labels_have_more(seed):
    """Against all 2^12 labels of a small grid;
    some of its pixels are decided by their evidence alone."""
    rng = np.random.default_rng(seed)
    shape = 3, 4
    evidence = rng.normal(0, 4, shape)
    evidence[0, 0], evidence[2, 3] = 60, -60
    costs = [rng.uniform(0, 3, neighbour_pairs(evidence, step)[0].shape) for step in NEIGHBOURS]
    everything = np.array(list(itertools.product((False, True), repeat=12))).reshape(-1, *shape)
    best = value(everything, evidence, costs).max()
    found = value(minimum_cut(evidence, costs), evidence, costs)
    # Capacities are rounded to 1/32: each of 12 + 29 numbers errs by 1/64 at most, on both sides.
    assert best - 41 / 32 <= found <= best + 1e-9


def test_noise_vanishes_and_edges_of_low_cost_stay():
    rng = np.random.default_rng(0)
    truth = np.zeros((40, 50), bool)
    truth[8:30, 12:40] = True
    evidence = np.where(truth, 1.0, -1.0) + rng.normal(0, 1.5, truth.shape)
    costs = []
    for step in NEIGHBOURS:
        first, second = neighbour_pairs(truth, step)
        costs.append(np.where(first == second, 3.0, 0.2))
    found = minimum_cut(evidence, costs)
    assert ((evidence > 0) ^ truth).mean() > 0.2
    assert (found ^ truth).mean() < 0.005


def test_nothing_and_everything():
    costs = [np.ones(neighbour_pairs(np.empty((5, 6)), step)[0].shape) for step in NEIGHBOURS]
    assert not minimum_cut(np.full((5, 6), -0.5), costs).any()
    assert minimum_cut(np.full((5, 6), 0.5), costs).all()
    alone = np.zeros((5, 6))
    alone[2, 2] = 100.0
    assert (minimum_cut(alone - 0.5, costs) == (ndimage.label(alone)[0] > 0)).all()
