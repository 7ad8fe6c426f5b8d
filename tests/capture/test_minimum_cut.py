"""The minimum cut: labels of minimal energy, and pixels that are decided by their evidence."""

import itertools

import numpy as np
import pytest

from ghgs_capture.minimum_cut import NEIGHBOURS, minimum_cut, neighbour_pairs


def value(labels, evidence, costs):
    """Objective that the cut maximises, for labels [..., h, w]."""
    chosen = (labels * evidence).sum((-2, -1))
    for step, cost in zip(NEIGHBOURS, costs, strict=True):
        first, second = neighbour_pairs(np.moveaxis(labels, (-2, -1), (0, 1)), step)
        chosen = chosen - ((first != second) * cost[(...,) + (None,) * (labels.ndim - 2)]).sum((0, 1))
    return chosen


@pytest.mark.parametrize("seed", range(6))
def test_no_other_labels_have_more(seed):
    """Compared with all 2^12 labels of a small grid; evidence alone decides some of its pixels."""
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
