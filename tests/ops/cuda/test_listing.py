"""The GPU's kernels that list the splats of tiles: equal to plain PyTorch,
which is gsplat's order."""

import pytest
import torch

from ghgs_lit.ops.intersections import intersections
from tests.helpers.kernels import DEVICE, kernels
from tests.rendering.test_intersections import splats


@pytest.mark.parametrize("size", [(3, 200, 60, 75), (1, 1, 16, 16), (2, 90, 100, 33), (40, 3, 400, 400)])
@pytest.mark.parametrize("capacity", [1, 300, 5000])
def test_lists_are_equal(size, capacity):
    """With room for some intersections, for all, and for more."""
    values = splats(*size)
    wanted = intersections(*values, *size[2:], capacity)
    with kernels() as called:
        found = intersections(*(value.to(DEVICE) for value in values), *size[2:], capacity)
    assert called == ["boxed", "placed"]
    for one, other in zip(found, wanted, strict=True):
        assert torch.equal(one.cpu(), other)
        assert one.dtype == other.dtype
