"""CPU kernel of the search along rays, bitwise equal to plain PyTorch: the arithmetic is the same."""

import dataclasses

import pytest

from ghgs_lit.method.bounds import VisualHull
from ghgs_lit.ops.ray_marching import march
from ghgs_lit.types import Batch
from tests.helpers.scenes import make_batch

SCENES = {
    "batch": {"batch": 2, "views": 4, "height": 70, "width": 98},
    "coarse": {"batch": 1, "views": 3, "height": 182, "width": 168},
    "cut": {"batch": 2, "views": 3, "zoom": 1.6},
    "opposite": {"batch": 1, "views": 2},
}


def spoil(batch: Batch) -> Batch:
    """Views with an empty mask, a full mask and a mask of a single pixel."""
    masks = batch.masks.clone()
    masks[0, 0] = False
    masks[-1, 1] = True
    if masks.shape[1] > 2:
        masks[-1, 2] = False
        masks[-1, 2, 20, 20] = True
    return dataclasses.replace(batch, masks=masks)


@pytest.mark.parametrize("change", [lambda batch: batch, spoil], ids=["clean", "spoiled"])
@pytest.mark.parametrize("tolerance", [0, 1])
@pytest.mark.parametrize("scene", SCENES)
def test_the_kernel_gives_the_bounds_of_plain_pytorch(monkeypatch, scene, tolerance, change):
    batch = change(make_batch(**SCENES[scene]))
    found = VisualHull(tolerance=tolerance)(dataclasses.replace(batch))
    monkeypatch.setitem(march.fits, "cpu", lambda *_: False)
    expected = VisualHull(tolerance=tolerance)(dataclasses.replace(batch))
    assert (found.near != expected.near).float().mean() < 1e-4
    assert (found.far != expected.far).float().mean() < 1e-4
