"""The search along rays, against masks looked up ray by ray."""

import numpy as np
import pytest
import torch

from ghgs_lit.method.bounds.hull import hull_bounds
from ghgs_lit.ops.ray_marching import march
from ghgs_lit.types import DepthBounds
from tests.helpers.scenes import make_batch


def by_hand(batch, start, tolerance, samples, v, row, column):
    """First and last allowed depths of one ray in float64; masks are not dilated, and no ray leaves the
    frames."""
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


@pytest.mark.parametrize("by_kernel", [True, False])
@pytest.mark.parametrize("tolerance", [0, 1])
def test_a_ray_ends_where_the_masks_of_the_other_views_end(monkeypatch, tolerance, by_kernel):
    """Both searches equal the definition of the hull, ray by ray."""
    if not by_kernel:
        monkeypatch.setitem(march.fits, "cpu", lambda *_: False)
    batch = make_batch(1, 4, 56, 70, zoom=0.6)
    start = DepthBounds(*(torch.full(batch.masks.shape, z) for z in (1.6, 2.5)))
    arguments = (batch.masks, batch.cameras, start, 0, tolerance, 12)
    found = hull_bounds(*arguments)
    rays = batch.masks[0].nonzero()[::37].tolist()
    assert len(rays) > 20
    expected = torch.tensor([by_hand(batch, start, tolerance, 12, *ray) for ray in rays])
    ends = torch.stack([torch.stack([b[0, v, i, j] for b in (found.near, found.far)]) for v, i, j in rays])
    assert ((ends - expected).abs() < 1e-4).all(-1).float().mean() > 0.98
