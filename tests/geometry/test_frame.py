"""The subject's frame: predictions do not depend on unit, origin and axes of the world."""

import dataclasses
import functools

import pytest
import torch
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from ghgs_lit.geometry.frame import HEIGHT, Frame
from ghgs_lit.geometry.rotations import quaternion_to_matrix
from ghgs_lit.rendering import render
from ghgs_lit.types import Batch
from tests.helpers.models import make_model, predict
from tests.helpers.scenes import CENTER, ellipsoid, make_batch, ring


def move_cameras(cameras, scale=1.0, turn=None, shift=(0.0, 0.0, 0.0)):
    """The cameras of a batch in a world that was scaled, rotated and translated, in float64."""
    turn = torch.eye(3).double() if turn is None else turn
    extrinsics = cameras.extrinsics.double().clone()
    rotation = extrinsics[..., :3, :3] @ turn.mT
    translation = scale * extrinsics[..., :3, 3] - (rotation * torch.tensor(shift).double()).sum(-1)
    extrinsics[..., :3, :3], extrinsics[..., :3, 3] = rotation, translation
    return dataclasses.replace(cameras, extrinsics=extrinsics)


@functools.cache
def original(name):
    """A tiny model, a batch with cameras in float64, its prediction and a render."""
    model, batch = make_model(f"model={name}").eval(), make_batch(1, 3)
    batch = dataclasses.replace(batch, cameras=move_cameras(batch.cameras))
    with torch.no_grad():
        prediction = predict(model, batch)
    return model, batch, prediction, render(prediction.gaussians, batch.cameras)


@pytest.mark.parametrize("name", ["paper", "hull"])
@settings(max_examples=5, deadline=None, phases=[Phase.explicit, Phase.generate])
@given(
    scale=st.sampled_from([1e-3, 0.03, 1.0, 11.0, 1e3]),
    turn=st.tuples(*4 * [st.floats(-1, 1)]),
    away=st.sampled_from([0.0, 1e4, 1e5]),
)
def test_a_moved_world_moves_the_gaussians_and_no_render(name, scale, turn, away):
    """Regression: the bounds' box was aligned with the world, limits were metres, and 100 km cost 11 mm."""
    model, batch, expected, image = original(name)
    turn = quaternion_to_matrix(torch.tensor(turn).double())
    shift = (away * scale, -0.3 * away * scale, 0.1 * away * scale)
    views = move_cameras(batch.cameras, scale, turn, shift)
    with torch.no_grad():
        found = predict(model, dataclasses.replace(batch, cameras=views))
        shown = render(found.gaussians, views)
    assert found.gaussians.splits == expected.gaussians.splits
    # float64 rounds to 1e-11 m at 100 km, which can change the last digit of a camera in float32.
    limit = 1e-5 + 2e-9 * away
    # In float32 points 100 km away are rounded to 8 mm.
    assert found.gaussians.means.dtype == found.points.tokens.dtype == torch.float64
    back = (found.gaussians.means - torch.tensor(shift).double()) @ turn / scale
    assert (back - expected.gaussians.means).abs().max() < limit
    back = (found.points.tokens - torch.tensor(shift).double()) @ turn / scale
    assert (back - expected.points.tokens).abs().max() < limit
    assert (found.depth / scale - expected.depth).abs().max() < limit
    for bound in ("near", "far"):
        one, other = (getattr(p.depth_maps.bounds, bound) for p in (found, expected))
        assert (one / scale - other).abs().max() < limit
    torch.testing.assert_close(found.gaussians.scales / scale, expected.gaussians.scales, rtol=1e-3, atol=0)
    one, other = (quaternion_to_matrix(p.gaussians.quaternions) for p in (found, expected))
    assert (turn.mT.float() @ one - other).abs().max() < 1e-3
    # At 100 km, two splats at almost the same depth may swap their order: 2.2e-5 in 4800 worlds.
    assert (shown.image - image.image).abs().mean() < 1e-5 + 2e-10 * away
    assert (shown.depth / scale - image.depth).abs().mean() < 1e-4


def test_the_subject_is_as_tall_as_a_person_in_its_frame():
    """An ellipsoid of 1.6 m becomes 1.8 m tall, in a world in millimetres as in metres."""
    batch = make_batch(2, 4, 112, 112)
    for scale in (1.0, 1e3):
        frame = Frame.of(dataclasses.replace(batch, cameras=move_cameras(batch.cameras, scale)))
        assert (frame.metre * HEIGHT / scale - 1.6).abs().max() < 0.1
        assert (frame.origin / scale - CENTER).abs().max() < 0.06
        assert frame.enter(batch).cameras.extrinsics.dtype == torch.float32


def size_with(batch, masks):
    """Size of the subject with other masks, relative to that with the true ones."""
    found, right = (Frame.of(b).metre for b in (dataclasses.replace(batch, masks=masks), batch))
    return float(found / right)


@pytest.mark.parametrize("wrong", ["empty", "one pixel", "noise", "half"])
@pytest.mark.parametrize("views", [3, 4])
def test_one_wrong_mask_does_not_change_the_size(views, wrong):
    batch = make_batch(1, views, 112, 112)
    noise = torch.rand(112, 112, generator=torch.Generator().manual_seed(0)) < 0.3
    rows, columns = torch.arange(112)[:, None], torch.arange(112)
    masks = batch.masks.clone()
    masks[0, -1] = {
        "empty": torch.zeros(112, 112, dtype=torch.bool),
        "one pixel": (rows == 3) & (columns == 5),
        "noise": noise,
        "half": masks[0, -1] & (rows < 56),
    }[wrong]
    assert size_with(batch, masks) == pytest.approx(1, abs=0.25)


@pytest.mark.parametrize("view", [0, 1])
def test_of_two_sizes_the_larger_counts(view):
    """Of two views the larger size is used, since masks are more often too small than too large."""
    batch = make_batch(1, 2, 112, 112, spread=180.0)
    masks = batch.masks.clone()
    masks[0, view, :41] = False  # the middle alone
    masks[0, view, 70:] = False
    assert size_with(batch, masks) == pytest.approx(1, abs=0.1)


def test_a_subject_that_is_wider_than_tall_has_the_size_of_its_width():
    """Cameras are held upright, or turned by 90 degrees."""
    batch = make_batch(1, 3, 112, 112)
    lying = torch.tensor([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])
    extrinsics, intrinsics = batch.cameras.extrinsics.clone(), batch.cameras.intrinsics.clone()
    extrinsics[..., :3, :] = lying @ extrinsics[..., :3, :]
    intrinsics[..., 0, 2] = batch.cameras.intrinsics[..., 1, 2]
    intrinsics[..., 1, 2] = 112 - batch.cameras.intrinsics[..., 0, 2]
    turned = dataclasses.replace(
        batch,
        masks=batch.masks.rot90(1, (-2, -1)),
        cameras=dataclasses.replace(batch.cameras, intrinsics=intrinsics, extrinsics=extrinsics),
    )
    torch.testing.assert_close(Frame.of(turned).metre, Frame.of(batch).metre, rtol=1e-6, atol=0)


MIRROR, HALF_TURN = torch.diag(torch.tensor([-1.0, 1.0, 1.0])), torch.diag(torch.tensor([-1.0, -1.0, 1.0]))
DOWN = torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
ROTATIONS = {
    "mirrored": lambda rotation: MIRROR @ rotation,
    "upside down": lambda rotation: HALF_TURN @ rotation,
    "looking down": lambda rotation: DOWN.expand_as(rotation),
    "opposed": lambda rotation: torch.cat((rotation[:, :1], *[rotation[:, :1] @ HALF_TURN] * 2), 1),
    "degenerate": torch.zeros_like,
}


@pytest.mark.parametrize("change", ROTATIONS)
def test_axes_are_a_rotation_for_any_cameras(change):
    """Mirrored extrinsics, rigs upside down and cameras that look straight down give a proper rotation,
    too."""
    batch, cameras = make_batch(1, 3, 42, 42), ring(1, 3, 42, 42)
    cameras.extrinsics[..., :3, :3] = ROTATIONS[change](cameras.extrinsics[..., :3, :3].clone())
    axes = Frame.of(dataclasses.replace(batch, cameras=cameras)).axes
    torch.testing.assert_close(axes @ axes.mT, torch.eye(3).double()[None], atol=1e-9, rtol=0)
    assert float(torch.linalg.det(axes)) == pytest.approx(1)


def test_the_origin_is_where_the_subject_stands():
    """The origin is the subject's centre even if cameras look half a metre to its side."""
    cameras, place = ring(1, 4, 112, 112, zoom=0.6), CENTER + torch.tensor([0.3, 0.0, -0.4])
    masks, depths = ellipsoid(cameras, place)
    batch = Batch(torch.zeros(1, 4, 3, 112, 112), masks, cameras, depths=depths)
    assert (Frame.of(batch).origin - place).abs().max() < 0.06  # as for one in the middle


def test_a_shared_frame_is_that_of_all():
    """Instants of one sequence share the mean origin, the first axes and the median size."""
    axes = quaternion_to_matrix(torch.randn(3, 4, generator=torch.Generator().manual_seed(0)).double())
    origin, metre = torch.tensor([[0.0, 0, 0], [1, 2, 3], [5, 1, 0]]), torch.tensor([5.0, 1.0, 2.0])
    shared = Frame(origin.double(), axes, metre.double()).shared
    assert shared.metre.tolist() == [2.0] * 3
    assert shared.origin.tolist() == [[2.0, 1.0, 1.0]] * 3
    assert torch.equal(shared.axes, axes[:1].expand(3, 3, 3))


def test_an_element_has_the_same_frame_alone():
    batch = make_batch(2, 4)
    whole = Frame.of(batch)
    one = Batch(batch.images[1:], batch.masks[1:], batch.cameras[1:])
    for name in ("origin", "axes", "metre"):
        assert torch.equal(getattr(Frame.of(one), name)[0], getattr(whole, name)[1])


def test_each_element_has_its_own_unit():
    """With one element in metres and one in millimetres, depths, bounds and sizes are in each one's unit."""
    batch = make_batch(2, 3)
    extrinsics = batch.cameras.extrinsics.double().clone()
    extrinsics[1, :, :3, 3] *= 1000
    mixed = dataclasses.replace(batch, cameras=dataclasses.replace(batch.cameras, extrinsics=extrinsics))
    model = make_model("model=hull").eval()
    with torch.no_grad():
        found, expected = predict(model, mixed), predict(model, batch)
    unit = torch.tensor([1.0, 1000.0])[:, None, None, None]
    torch.testing.assert_close(found.depth / unit, expected.depth, rtol=1e-4, atol=0)
    for bound in ("near", "far"):
        one, other = (getattr(p.depth_maps.bounds, bound) for p in (found, expected))
        torch.testing.assert_close(one / unit, other, rtol=1e-4, atol=0)
    element = found.gaussians.image // 3
    for name in ("scales", "means"):
        one, other = (getattr(p.gaussians, name).float() for p in (found, expected))
        torch.testing.assert_close(one / unit[:, :, 0, 0][element], other, rtol=1e-3, atol=1e-4)
    torch.testing.assert_close(
        found.gaussians.metre, expected.gaussians.metre * unit[:, 0, 0, 0], rtol=1e-4, atol=0
    )


def test_units_of_nested_frames_are_multiplied():
    """The ``metre`` of Gaussians in a frame is multiplied by that of the frame."""
    gaussians = original("hull")[2].gaussians
    inner = dataclasses.replace(gaussians, metre=torch.tensor([4.0]))
    frame = Frame(torch.zeros(1, 3).double(), torch.eye(3).double()[None], torch.tensor([2.5]).double())
    world = torch.zeros(1, 4, 3)
    assert frame._gaussians(inner, 3, world).metre.tolist() == [10.0]
    assert frame._gaussians(dataclasses.replace(inner, metre=None), 3, world).metre.tolist() == [2.5]
