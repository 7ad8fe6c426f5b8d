"""The GPU's kernels of the photo-consistency against plain PyTorch in float64."""

import dataclasses

import pytest
import torch

from ghgs_lit.method.bounds import VisualHull
from ghgs_lit.ops import photo_consistency as stage
from ghgs_lit.ops.photo_consistency import photo_consistency
from ghgs_lit.types import DepthBounds
from tests.helpers.kernels import DEVICE, kernels
from tests.helpers.scenes import in_dtype, make_batch

SCENES = [(2, 4, 28, 42, 360.0), (1, 5, 42, 28, 360.0), (2, 2, 28, 28, 60.0), (1, 3, 56, 56, 150.0)]
EPS = torch.finfo(torch.float32).eps


def bounds_of(batch):
    hull = VisualHull()(batch)
    return hull, DepthBounds(-hull.far, hull.far)  # also behind the cameras


@pytest.mark.parametrize("steps", [1, 5])
@pytest.mark.parametrize(("b", "v", "height", "width", "spread"), SCENES)
def test_the_agreement_is_as_exact_as_plain_pytorchs(b, v, height, width, spread, steps):
    """Behind cameras and outside frames, too; a view is empty, a pixel is not finite."""
    batch = make_batch(b, v, height, width, spread=spread)
    batch.masks[-1, 0] = False
    batch.images[0, -1, :, height // 2, width // 2] = torch.nan
    for bounds in bounds_of(batch):
        exact = photo_consistency(in_dtype(batch, torch.float64), bounds.to(torch.float64), steps)
        fresh = dataclasses.replace(batch).to(DEVICE)
        with kernels() as called:
            found = photo_consistency(fresh, bounds.to(DEVICE), steps)
        assert called == ["swept"]
        # Pixels are exact to roundings of the frame's size times the depth's ratio to the least
        # in front of a camera; colours differ by up to 1 a pixel, and the agreement by 1 /
        # TOLERANCE of that.
        difference = (found.cpu() - exact).abs()
        assert difference.max() < 1e-3
        assert difference.mean() < 64 * EPS / stage.TOLERANCE


def test_strides_change_nothing_and_no_pixel_has_no_agreement():
    batch = make_batch(2, 3, 28, 42)
    near, far = (bound.flatten()[batch.pixels] for bound in dataclasses.astuple(VisualHull()(batch)))
    strided = dataclasses.replace(
        batch, images=batch.images.transpose(3, 4).contiguous().transpose(3, 4), masks=batch.masks.clone()
    )
    with kernels():
        expected = stage.consistency_of(*(x.to(DEVICE) for x in (batch, batch.pixels, near, far)), 3)
        found = stage.consistency_of(
            *(x.to(DEVICE) for x in (strided, batch.pixels, near.repeat_interleave(2)[::2], far)), 3
        )
        none = stage.consistency_of(*(x.to(DEVICE) for x in (batch, batch.pixels[:0], near[:0], far[:0])), 3)
    assert torch.equal(found, expected)
    assert none.shape == (0, 3)
