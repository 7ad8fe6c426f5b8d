"""Bounds contain the true depth, stay finite, and are as tight as masks and cameras allow."""

import dataclasses

import pytest
import torch
import torch.nn.functional as F

from ghgs_lit.geometry.projection import unproject_maps
from ghgs_lit.method.bounds import SubjectBox, VisualHull
from ghgs_lit.method.bounds.box import subject_box
from ghgs_lit.method.bounds.rays import cut_sides, depths_in_box, dilate, silhouettes, votes_outside
from ghgs_lit.types import Batch, DepthBounds
from tests.helpers.cameras import camera_ring
from tests.helpers.figures import PARTS
from tests.helpers.scenes import CENTER, RADII, ellipsoid, make_batch, ring

STAGES = [SubjectBox, VisualHull]


def near_and_far(stage, batch, **changes):
    """Both bounds of a batch with some fields replaced."""
    bounds = stage(dataclasses.replace(batch, **changes))
    return bounds.near, bounds.far


def inside(near, far, batch, slack=1e-4):
    """Fraction of the subject's pixels whose true depth lies within the bounds."""
    good = (near <= batch.depths + slack) & (batch.depths <= far + slack)
    return good[batch.masks].float().mean().item()


@pytest.mark.parametrize("stage", STAGES)
@pytest.mark.parametrize(
    ("views", "size", "zoom"),
    [(2, (56, 56), 0.8), (3, (70, 42), 0.8), (4, (42, 56), 0.8), (5, (56, 56), 0.8), (4, (56, 56), 1.6)],
)
def test_true_depth_is_within_the_bounds(stage, views, size, zoom):
    """Bounds that exclude the surface would make the true depth unreachable; with the last zoom, the frame
    cuts the subject, and space outside a view's frame does not count as empty."""
    batch = make_batch(2 - (zoom > 1), views, *size, spread=180.0 if views == 2 else 360.0, zoom=zoom)
    assert batch.masks[:, :, 0].any() == (zoom > 1)
    near, far = near_and_far(stage(), batch)
    assert near.shape == far.shape == batch.masks.shape
    assert (near > 0).all()
    assert (far - near > 0.0199).all()
    assert inside(near, far, batch) == 1


@pytest.mark.parametrize("resolution", [30, 50, 160])
def test_a_coarse_search_stays_conservative(resolution, monkeypatch):
    """A low search resolution may widen the bounds, but never cut the subject off."""
    monkeypatch.setattr("ghgs_lit.method.bounds.box.RESOLUTION", resolution)
    batch = make_batch(1, 4, 112, 112)
    near, far = near_and_far(VisualHull(), batch)
    assert inside(near, far, batch) == 1
    box = near_and_far(SubjectBox(), batch)
    assert (near >= box[0] - 0.0101).all()  # half the least thickness
    assert (far <= box[1] + 0.0201).all()


def test_the_hull_is_tighter_than_the_box_and_close_to_the_subject():
    """A hull as wide as the box would not be worth its time."""
    batch = make_batch(1, 5, 112, 112)
    lengths = {}
    for stage in STAGES:
        near, far = near_and_far(stage(dilation=0.0), batch)
        lengths[stage] = (far - near)[batch.masks].mean()
    assert lengths[VisualHull] < 0.7 * lengths[SubjectBox]
    assert lengths[VisualHull] < 0.55  # the mean chord of the ellipsoid is about 0.3 m


@pytest.mark.parametrize("view", [1, 3])
def test_legs_below_one_frame_are_kept_for_the_other_views(view):
    """One leg is in front of the other: below the frame they do not continue straight down."""
    cameras = camera_ring(4, 84, 84, focal=(92.0, 92.0), center=(0, 0.9, 0), raised=0.4, radius=2.4)
    intrinsics = cameras.intrinsics.clone()
    intrinsics[0, view, 1, 2] += 44
    cameras = dataclasses.replace(cameras, intrinsics=intrinsics)
    parts = [ellipsoid(cameras, torch.tensor(center), torch.tensor(radii)) for center, radii in PARTS]
    masks = torch.stack([mask for mask, _ in parts]).any(0)
    depths = torch.stack([depth.where(mask, torch.inf) for mask, depth in parts]).amin(0)
    assert cut_sides(masks)[0].any(-1).nonzero().tolist() == [[view]]
    batch = Batch(masks[:, :, None].repeat(1, 1, 3, 1, 1).float(), masks, cameras, depths=depths)
    assert inside(*near_and_far(VisualHull(), batch), batch) == 1


def test_a_frame_that_cuts_nothing_says_what_is_outside():
    """Beyond a side that the subject touches, space is unknown; beyond the others it is empty."""
    masks = torch.zeros(1, 2, 6, 8, dtype=torch.bool)
    masks[0, 0, 2:4, :3] = True
    masks[0, 1, 2:4, 2:5] = True
    votes = votes_outside(masks, torch.ones(1, 2, dtype=torch.bool), cut_sides(masks))
    expected = (~masks).byte()
    expected[0, 0, :, 0] = 0
    assert torch.equal(votes, expected)


@pytest.mark.parametrize("stage", STAGES)
def test_an_empty_mask_does_not_vote(stage):
    """A view without the subject would otherwise carve everything away."""
    batch = make_batch(2, 3, 56, 56)
    masks = batch.masks.clone()
    masks[0, 1] = False
    near, far = near_and_far(stage(), batch, masks=masks)
    assert torch.stack((near, far)).isfinite().all()
    assert inside(near, far, dataclasses.replace(batch, masks=masks)) == 1
    near, far = near_and_far(stage(), batch, masks=torch.zeros_like(masks))
    assert near.isfinite().all()
    assert (far > near).all()


def test_tolerance_outvotes_a_wrong_mask():
    """One wrong mask does not cut off parts that the other views show."""
    batch = make_batch(1, 5, 56, 56)
    wrong = batch.masks.clone()
    wrong[0, 2, 20:] = False  # one view has lost everything below the head
    others = [0, 1, 3, 4]
    near, far = near_and_far(VisualHull(tolerance=1), batch, masks=wrong)
    good = (near <= batch.depths) & (batch.depths <= far)
    assert good[:, others][batch.masks[:, others]].all()
    feet = [subject_box(wrong, batch.cameras, 1, tolerance)[0][0, 1] for tolerance in (0, 1)]
    assert feet[1] <= (CENTER - RADII)[1] < feet[0] - 0.3


def test_masks_that_contradict_one_another_fall_back_to_the_box():
    """An empty hull gives finite bounds, not NaN."""
    batch = make_batch(1, 3, 56, 56)
    masks = torch.zeros_like(batch.masks)
    masks[0, 0, :6, :6] = masks[0, 1, -6:, -6:] = masks[0, 2, :6, -6:] = True
    hull = near_and_far(VisualHull(dilation=0.0), batch, masks=masks)
    assert all(value.isfinite().all() for value in hull)
    assert (hull[1] > hull[0]).all()


def test_depths_in_a_box_end_on_its_faces():
    """Entry and exit points of a ray lie on the box."""
    cameras = ring(2, 3, 28, 42)
    lower, upper = torch.tensor([[-0.3, 0.2, -0.4]] * 2), torch.tensor([[0.5, 1.6, 0.3]] * 2)
    bounds = depths_in_box(cameras, lower, upper)
    hits = ellipsoid(cameras, radii=torch.tensor([0.1, 0.5, 0.1]))[0]  # rays that surely hit
    for depth in (bounds.near, bounds.far):
        points = unproject_maps(depth, cameras)[hits]
        beyond = torch.maximum(lower[0] - points, points - upper[0]).amax(-1)
        torch.testing.assert_close(beyond, torch.zeros_like(beyond), atol=1e-5, rtol=0)


@pytest.mark.parametrize("radius", [0, 1, 3, 40])
def test_dilation_is_a_maximum_over_a_square(radius):
    """The fast dilation equals its definition at every radius."""
    masks = torch.rand(2, 3, 17, 23, generator=torch.Generator().manual_seed(0)) > 0.97
    padded = F.pad(masks.float(), (radius,) * 4)
    expected = padded.unfold(-2, 2 * radius + 1, 1).unfold(-2, 2 * radius + 1, 1).amax((-1, -2)).bool()
    assert torch.equal(dilate(masks, radius), expected)


@pytest.mark.parametrize("factor", [1e-30, 1e-6, 1e6, 1e30])
def test_cameras_of_absurd_sizes_give_finite_bounds(factor):
    """Cameras in other units do not overflow into NaN bounds."""
    batch = make_batch(1, 3)
    cameras = batch.cameras
    for name, index in (("intrinsics", (..., [0, 1], [0, 1])), ("extrinsics", (..., slice(3), 3))):
        changed = getattr(cameras, name).clone()
        changed[index] *= factor
        odd = dataclasses.replace(cameras, **{name: changed})
        for stage in STAGES:
            near, far = near_and_far(stage(), batch, cameras=odd)
            assert ((near > 0) & (far >= near) & far.isfinite()).all()


def test_autocast_changes_nothing():
    """Geometry in half precision would be off by centimetres."""
    batch = make_batch(1, 3)
    expected = near_and_far(VisualHull(), batch)
    with torch.autocast("cpu", torch.bfloat16):
        found = near_and_far(VisualHull(), batch)
    assert all(torch.equal(a, b) for a, b in zip(expected, found, strict=True))


@pytest.mark.parametrize("size", [(40, 160), (160, 40)])
def test_dilation_is_a_share_of_the_longer_side(size):
    """Dilation is rounded to whole cells of the search, for upright and landscape images."""
    masks = torch.zeros(1, 2, *size, dtype=torch.bool)
    for resolution, stride, dilation in ((160, 1, 8), (80, 2, 4)):
        found = silhouettes(masks, ring(1, 2, *size), resolution, 0.05)
        assert (found.stride, found.dilation) == (stride, dilation)


def test_the_box_has_a_margin_on_every_side(monkeypatch):
    batch, asked = make_batch(1, 4), []
    anything = DepthBounds(batch.depths, batch.depths)
    monkeypatch.setattr(SubjectBox, "_within", lambda self, *given: asked.append(given) or anything)
    SubjectBox()(batch)
    _, coarse, _, lower, upper = asked[0]
    expected = subject_box(coarse.masks, coarse.cameras, coarse.dilation)
    torch.testing.assert_close(torch.stack((lower + 0.03, upper - 0.03)), torch.stack(expected))


@pytest.mark.parametrize(("across", "down", "slack"), [(1.0, 1.0, 0.0), (2.0, 1.0, 0.02), (1.0, 2.0, 0.02)])
def test_the_box_holds_the_subject_and_little_more(across, down, slack):
    """Also a pole in images stretched along x or y: pixels need not be square."""
    radii = RADII if across == down else torch.tensor([0.1, 0.8, 0.1])
    focal, principal = (45 * across, 45 * down), (28 * across, 28 * down)
    place = {"center": tuple(CENTER.tolist()), "raised": 0.3, "radius": 2.0}
    cameras = camera_ring(4, int(56 * down), int(56 * across), 2, focal, principal, **place)
    lower, upper = subject_box(ellipsoid(cameras, radii=radii)[0], cameras, radius=int(across == down))
    low, high = CENTER - radii, CENTER + radii
    assert ((lower <= low + slack) & (lower >= low - 0.25)).all()
    assert ((upper >= high - slack) & (upper <= high + 0.25)).all()


def test_bounds_that_are_too_close_are_moved_apart_to_the_least_thickness():
    """By equal amounts on both sides, but not past the camera; others stay."""
    near, far = torch.tensor([[2.0, 2.0, 0.1, torch.nan], [2.004, 2.5, 0.1, torch.inf]])[:, None, None, None]
    found = SubjectBox()._make_valid(DepthBounds(near, far))
    torch.testing.assert_close(found.near.flatten(), torch.tensor([1.992, 2.0, 0.1, 0.1]))
    torch.testing.assert_close(found.far.flatten(), torch.tensor([2.012, 2.5, 0.12, 1e6]))
