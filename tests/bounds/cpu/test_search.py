"""The kernels of the bounds against plain PyTorch, and against the masks looked up ray by ray."""

import dataclasses

import numpy as np
import pytest
import torch

from ghgs_lit.bounds import VisualHull
from ghgs_lit.bounds.box import subject_box
from ghgs_lit.bounds.hull import hull_bounds
from ghgs_lit.types import Batch, DepthBounds
from tests.helpers.scenes import make_batch

SCENES = {
    "batch": {"batch": 2, "views": 4, "height": 70, "width": 98},
    "narrow": {"batch": 1, "views": 5, "height": 98, "width": 42},
    "cut": {"batch": 2, "views": 3, "zoom": 1.6},
    "opposite": {"batch": 1, "views": 2},
}


@pytest.fixture
def plain(monkeypatch):
    """Calls a function without the kernels."""

    def call(function, *arguments):
        with monkeypatch.context() as patch:
            for module in ("box", "hull"):
                patch.setattr(f"ghgs_lit.bounds.{module}.is_supported", lambda *_: False)
            return function(*arguments)

    return call


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
def test_kernels_give_the_bounds_of_plain_pytorch(plain, scene, tolerance, change):
    """Rounding may move a sample across a border of a mask, by one sample and hardly ever."""
    batch = change(make_batch(**SCENES[scene]))
    stage = VisualHull(tolerance=tolerance)
    found, expected = stage(batch), plain(stage, batch)
    lengths = expected.far - expected.near
    for name in ("near", "far"):
        difference = (getattr(found, name) - getattr(expected, name)).abs()
        assert (difference > 1e-5).float().mean() < 1e-3, name
        assert (difference <= 0.1 * lengths + 1e-5).all(), name
    corners = (batch.masks, batch.cameras, 2, tolerance)
    for a, b in zip(subject_box(*corners), plain(subject_box, *corners), strict=True):
        torch.testing.assert_close(a, b, atol=1e-5, rtol=1e-5)


def by_hand(batch, start, tolerance, samples, v, row, column):
    """First and last allowed depth of one ray in float64; undilated masks, no ray leaves the frames."""
    masks = batch.masks[0].numpy()
    intrinsics, extrinsics = (
        x[0].double().numpy() for x in (batch.cameras.intrinsics, batch.cameras.extrinsics)
    )
    near, far = (float(bound[0, v, row, column]) for bound in (start.near, start.far))
    step, allowed = (far - near) / samples, []
    for s in range(samples):
        z = near + (s + 0.5) * step
        ray = np.linalg.inv(intrinsics[v]) @ [column + 0.5, row + 0.5, 1]
        world = extrinsics[v, :3, :3].T @ (z * ray - extrinsics[v, :3, 3])
        votes = 0
        for u in range(len(masks)):
            x, y, w = intrinsics[u] @ (extrinsics[u, :3, :3] @ world + extrinsics[u, :3, 3])
            votes += u != v and not masks[u, int(y / w), int(x / w)]
        allowed += [z] if votes <= tolerance else []
    return (allowed[0] - step / 2, allowed[-1] + step / 2) if allowed else (near, far)


@pytest.mark.parametrize("kernels", [True, False])
@pytest.mark.parametrize("tolerance", [0, 1])
def test_a_ray_ends_where_the_masks_of_the_other_views_end(plain, kernels, tolerance):
    """Both searches against the definition of the hull, ray by ray."""
    batch = make_batch(1, 4, 56, 70, zoom=0.6)
    start = DepthBounds(*(torch.full(batch.masks.shape, z) for z in (1.6, 2.5)))
    arguments = (batch.masks, batch.cameras, start, 0, tolerance, 12)
    found = hull_bounds(*arguments) if kernels else plain(hull_bounds, *arguments)
    rays = batch.masks[0].nonzero()[::37].tolist()
    assert len(rays) > 20
    expected = torch.tensor([by_hand(batch, start, tolerance, 12, *ray) for ray in rays])
    ends = torch.stack([torch.stack([b[0, v, i, j] for b in (found.near, found.far)]) for v, i, j in rays])
    assert ((ends - expected).abs() < 1e-4).all(-1).float().mean() > 0.98


def test_the_number_of_threads_changes_no_bit():
    """Tasks write apart: an order of threads must not show."""
    batch, threads = make_batch(2, 4, 112, 112), torch.get_num_threads()
    results = []
    try:
        for count in (1, 3):
            torch.set_num_threads(count)
            results.append(VisualHull()(batch))
    finally:
        torch.set_num_threads(threads)
    assert torch.equal(results[0].near, results[1].near)
    assert torch.equal(results[0].far, results[1].far)
