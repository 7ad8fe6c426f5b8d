"""Cameras around a subject."""

import torch

from ghgs_lit.visualization.turntable import look_at_point, turntable
from tests.helpers.training import ring


def test_a_turntable_of_a_ring_is_the_ring():
    """The turn passes through the given cameras, which are on a circle around the subject."""
    cameras = ring(4, 20)
    assert torch.allclose(look_at_point(cameras), torch.zeros(3, dtype=torch.float64), atol=1e-6)
    orbit = turntable(cameras[torch.tensor([0, 2])], 4)
    assert torch.allclose(orbit.extrinsics[0], cameras.extrinsics[0], atol=1e-5)
    assert torch.allclose(orbit.extrinsics[2], cameras.extrinsics[2], atol=1e-5)
    assert torch.allclose(torch.linalg.det(orbit.extrinsics[:, :3, :3]), torch.ones(4), atol=1e-5)
    assert torch.allclose(orbit.centers.norm(dim=-1), torch.full((4,), 2.0), atol=1e-5)
