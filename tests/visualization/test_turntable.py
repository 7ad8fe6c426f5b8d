"""Cameras on a circle around a subject."""

import pytest
import torch
from scipy.spatial.transform import Rotation

from ghgs_lit.geometry.projection import look_at_point
from ghgs_lit.types import Cameras
from ghgs_lit.visualization.turntable import turntable, up_direction
from tests.helpers.training import ring


def test_a_turntable_of_a_ring_is_the_ring():
    """The circle passes through given cameras that lie on a circle around the subject."""
    cameras = ring(4, 20)
    assert torch.allclose(look_at_point(cameras), torch.zeros(3, dtype=torch.float64), atol=1e-6)
    orbit = turntable(cameras[torch.tensor([0, 2])], 4)
    assert torch.allclose(orbit.extrinsics[0], cameras.extrinsics[0], atol=1e-5)
    assert torch.allclose(orbit.extrinsics[2], cameras.extrinsics[2], atol=1e-5)
    assert torch.allclose(torch.linalg.det(orbit.extrinsics[:, :3, :3]), torch.ones(4), atol=1e-5)
    assert torch.allclose(orbit.centers.norm(dim=-1), torch.full((4,), 2.0), atol=1e-5)


@pytest.mark.parametrize("pitch", [-30, 0, 40])
@pytest.mark.parametrize("yaws", [(0, 90, 180, 270), (-20, 0, 20), (10,)])
def test_up_does_not_depend_on_where_cameras_look(pitch, yaws):
    """Cameras on one side that all look down have a tilted mean up direction, but the estimate is
    upright. A single camera is level."""
    turned = Rotation.from_euler("YX", [(yaw, pitch) for yaw in yaws], degrees=True)
    for world in (Rotation.identity(), Rotation.from_rotvec([0.4, 0.3, 1.0])):
        extrinsics = torch.eye(4).repeat(len(yaws), 1, 1)
        extrinsics[:, :3, :3] = torch.tensor((world * turned).inv().as_matrix())
        cameras = Cameras(torch.eye(3).expand(len(yaws), 3, 3), extrinsics, 10, 10)
        wanted = torch.tensor(world.apply([0, -1, 0]))
        if len(yaws) == 1:  # a single image does not determine it: its column is used
            wanted = -extrinsics[0, 1, :3].double()
        assert up_direction(cameras) @ wanted > (0.9997 if len(yaws) > 1 else 1 - 1e-6)
