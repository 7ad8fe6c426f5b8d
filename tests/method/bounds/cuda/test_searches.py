"""The GPU's kernels of the bounds against plain PyTorch."""

import dataclasses

import pytest
import torch

from ghgs_lit.method.bounds import VisualHull
from ghgs_lit.method.bounds.rays import _grown, dilate
from ghgs_lit.types import Batch
from tests.helpers.kernels import DEVICE, kernels
from tests.helpers.scenes import make_batch

SCENES = {
    "batch": {"batch": 2, "views": 4, "height": 28, "width": 42},
    "narrow": {"batch": 1, "views": 5, "height": 56, "width": 28},
    "cut": {"batch": 2, "views": 3, "height": 28, "width": 28, "zoom": 1.6},
    "opposite": {"batch": 1, "views": 2, "height": 28, "width": 28},
}


def spoiled(batch: Batch) -> Batch:
    """Views with an empty mask, a full one and a single pixel."""
    masks = batch.masks.clone()
    masks[0, 0] = False
    masks[-1, 1] = True
    if masks.shape[1] > 2:
        masks[-1, 2] = False
        masks[-1, 2, 20, 20] = True
    return dataclasses.replace(batch, masks=masks)


@pytest.mark.parametrize("change", [lambda batch: batch, spoiled], ids=["clean", "spoiled"])
@pytest.mark.parametrize("tolerance", [0, 1])
@pytest.mark.parametrize("scene", SCENES)
def test_bounds_are_those_of_plain_pytorch(scene, tolerance, change):
    """Rounding may move a sample across a border of a mask, by one sample and hardly ever."""
    batch = change(make_batch(**SCENES[scene]))
    stage = VisualHull(tolerance=tolerance)
    expected = stage(batch)
    with kernels() as called:
        found = stage(dataclasses.replace(batch).to(DEVICE))
    assert set(called) == {"dilated", "carved", "marched"}
    lengths = expected.far - expected.near
    for name in ("near", "far"):
        difference = (getattr(found, name).cpu() - getattr(expected, name)).abs()
        assert (difference > 1e-5).float().mean() < 2e-3, name
        assert (difference <= 0.1 * lengths + 1e-5).all(), name


@pytest.mark.parametrize("radius", [0, 1, 3, 40])
@pytest.mark.parametrize("strides", [(0, 1, 2, 3), (1, 0, 3, 2)])
def test_masks_grow_by_radii_of_their_own(radius, strides):
    generator = torch.Generator().manual_seed(0)
    masks = torch.rand(2, 3, 17, 23, generator=generator).permute(strides) > 0.97
    more = torch.arange(len(masks), dtype=torch.int32) * 2
    for own in (None, more):
        expected = _grown(_grown(masks, radius, own, -2), radius, own, -1)
        with kernels() as called:
            found = dilate(masks.to(DEVICE), radius, None if own is None else own.to(DEVICE))
            none = dilate(masks[:0].to(DEVICE), radius)
        assert called == ["dilated"] * 4
        assert torch.equal(found.cpu(), expected)
        assert none.shape == masks[:0].shape
