"""Axes of surfaces whose normals are known."""

import dataclasses

import pytest
import torch

from ghgs_lit.geometry.projection import unproject_maps
from ghgs_lit.geometry.rotations import multiply_quaternions, quaternion_to_matrix
from ghgs_lit.ops.activation import surface_axes
from ghgs_lit.types import Cameras, DepthMaps
from tests.helpers.scenes import CENTER, RADII, ellipsoid, make_batch, ring


def axes_of(batch, valid=None):
    """Matrices [N, 3, 3] of the axes of all valid pixels."""
    valid = batch.masks if valid is None else valid
    image, pixel = valid.flatten(0, 1).flatten(1).nonzero(as_tuple=True)
    maps = DepthMaps(batch.depths, valid, batch.depths)
    return quaternion_to_matrix(surface_axes(maps, batch.cameras, image, pixel))


def camera_axes(batch):
    """Right, down and forward [N, 3, 3] of each pixel's camera, as columns."""
    own = batch.masks.flatten(0, 1).flatten(1).sum(1)
    return batch.cameras.extrinsics[..., :3, :3].flatten(0, 1).mT.repeat_interleave(own, 0)


def test_the_third_axis_is_the_inward_normal_of_an_ellipsoid():
    """Against the gradient of its equation; the axes are a rotation of the camera's,
    by the least angle."""
    cameras = ring(2, 3, 140, 112)
    masks, depths = ellipsoid(cameras)
    batch = dataclasses.replace(make_batch(2, 3, 140, 112), masks=masks, depths=depths)
    found = axes_of(batch)
    points = unproject_maps(depths, cameras)[masks]
    normal = torch.nn.functional.normalize((CENTER - points) / RADII.square(), dim=-1)
    cosine = (found[:, :, 2] * normal).sum(-1)
    assert cosine.quantile(0.05) > 0.99  # the rim is a slope between neighbours, which bends
    assert cosine.min() > 0.7
    torch.testing.assert_close(found.det(), torch.ones(len(found)))
    camera = camera_axes(batch)
    # The least rotation turns about an axis in the image's plane.
    turned = found @ camera.mT
    angle = ((turned.diagonal(dim1=1, dim2=2).sum(-1) - 1) / 2).clamp(-1, 1).acos()
    between = (found[:, :, 2] * camera[:, :, 2]).sum(-1).clamp(-1, 1).acos()
    torch.testing.assert_close(angle, between, atol=2e-3, rtol=0)


def slanted(slope_x, slope_y, dtype=torch.float64):
    """A plane z = 2 + a x + b y before a camera at the origin that looks along z,
    with its depths."""
    size, fx, fy, skew = 20, 30.0, 36.0, 3.0
    lens = torch.tensor([[fx, skew, size / 2 + 1], [0, fy, size / 2 - 2], [0, 0, 1]], dtype=dtype)
    centers = torch.arange(size, dtype=dtype) + 0.5
    v, u = torch.meshgrid(centers, centers, indexing="ij")
    y = (v - lens[1, 2]) / fy
    x = (u - lens[0, 2] - skew * y) / fx
    depth = 2 / (1 - slope_x * x - slope_y * y)
    cameras = Cameras(lens[None, None], torch.eye(4, dtype=dtype)[None, None], size, size)
    return depth[None, None], cameras


@pytest.mark.parametrize(("a", "b"), [(0.0, 0.0), (1.5, 0.0), (-0.4, 1.0)])
def test_planes_are_exact_up_to_their_border(a, b):
    """One-sided differences at the border of the image and of the mask are exact on a plane,
    too."""
    depth, cameras = slanted(a, b)
    valid = torch.ones_like(depth, dtype=torch.bool)
    valid[..., 7:9, 3:5] = False
    depth[~valid] += 0.01  # near the plane, yet not the subject's
    image, pixel = valid.flatten(0, 1).flatten(1).nonzero(as_tuple=True)
    normal = quaternion_to_matrix(surface_axes(DepthMaps(depth, valid, depth), cameras, image, pixel))[..., 2]
    expected = torch.nn.functional.normalize(torch.tensor([-a, -b, 1.0], dtype=depth.dtype), dim=0)
    torch.testing.assert_close(normal, expected.expand_as(normal))


def test_surfaces_do_not_mix():
    """A step of a metre, and what lies outside the mask, say nothing of the normal."""
    depth, cameras = slanted(0.0, 0.0)
    depth[..., 10:] += 1.0
    depth[..., :3] = 77.0
    valid = torch.ones_like(depth, dtype=torch.bool)
    valid[..., :3] = False
    image, pixel = valid.flatten(0, 1).flatten(1).nonzero(as_tuple=True)
    axes = quaternion_to_matrix(surface_axes(DepthMaps(depth, valid, depth), cameras, image, pixel))
    torch.testing.assert_close(axes, torch.eye(3, dtype=axes.dtype).expand_as(axes))


def test_lonely_pixels_have_the_axes_of_their_camera():
    """Pixels without a neighbour, also in corners of the image."""
    batch = make_batch(1, 3)
    valid = torch.zeros_like(batch.masks)
    valid[..., ::55, ::55] = True
    valid[..., 27, 29] = True
    single = dataclasses.replace(batch, masks=valid, depths=torch.full_like(batch.depths, 2.0))
    torch.testing.assert_close(axes_of(single), camera_axes(single))


def test_axes_turn_with_the_world_and_do_not_depend_on_batch_mates():
    """The same photographs in a world with other axes and origin, and alone."""
    batch = make_batch(2, 3)
    image, pixel = batch.masks.flatten(0, 1).flatten(1).nonzero(as_tuple=True)
    maps = DepthMaps(batch.depths, batch.masks, batch.depths)
    found = surface_axes(maps, batch.cameras, image, pixel)
    turn = torch.nn.functional.normalize(torch.tensor([0.3, -0.5, 0.7, 0.2]), dim=0)
    world = torch.eye(4)
    world[:3, :3], world[:3, 3] = quaternion_to_matrix(turn), torch.tensor([3.0, -20.0, 9.0])
    moved = dataclasses.replace(batch.cameras, extrinsics=batch.cameras.extrinsics @ world.inverse())
    turned = surface_axes(maps, moved, image, pixel)
    expected = multiply_quaternions(turn.expand_as(found), found)
    torch.testing.assert_close(
        quaternion_to_matrix(turned), quaternion_to_matrix(expected), atol=1e-5, rtol=0
    )
    part, own = slice(1, 2), image >= 3
    alone = surface_axes(
        DepthMaps(batch.depths[part], batch.masks[part], batch.depths[part]),
        batch.cameras[part],
        image[own] - 3,
        pixel[own],
    )
    assert torch.equal(alone, found[own])
