"""The kernel of the photo-consistency against plain PyTorch."""

import dataclasses

import pytest
import torch

from ghgs_lit.method.bounds import VisualHull
from ghgs_lit.ops.photo_consistency import photo_consistency
from ghgs_lit.types import DepthBounds
from tests.helpers.kernels import plain_pytorch
from tests.helpers.scenes import make_batch

SCENES = [(2, 4, 70, 98, 360.0), (1, 5, 98, 42, 360.0), (2, 2, 56, 56, 60.0), (1, 3, 56, 56, 150.0)]


@pytest.mark.parametrize("steps", [1, 7])
@pytest.mark.parametrize(("b", "v", "height", "width", "spread"), SCENES)
def test_the_kernel_gives_the_agreement_of_plain_pytorch(b, v, height, width, spread, steps):
    """Also behind cameras and outside frames; one view is empty."""
    batch = make_batch(b, v, height, width, spread=spread)
    batch.masks[-1, 0] = False
    hull = VisualHull()(batch)
    assert photo_consistency(batch, hull, steps).any()
    for bounds in (hull, DepthBounds(-hull.far, hull.far)):
        found = photo_consistency(batch, bounds, steps)
        with plain_pytorch():
            expected = photo_consistency(dataclasses.replace(batch), bounds, steps)
        torch.testing.assert_close(found, expected, atol=1e-4, rtol=0)


def test_the_number_of_threads_changes_no_bit():
    """Tasks write apart: an order of threads must not show."""
    batch, threads = make_batch(2, 4, 112, 112), torch.get_num_threads()
    bounds, results = VisualHull()(batch), []
    try:
        for count in (1, 3):
            torch.set_num_threads(count)
            results.append(photo_consistency(batch, bounds, 4))
    finally:
        torch.set_num_threads(threads)
    assert torch.equal(*results)
