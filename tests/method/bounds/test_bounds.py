"""Bounds contain the true depth, stay finite, and are as tight as masks and cameras allow."""

import dataclasses

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from ghgs_lit.geometry.projection import unproject_maps
from ghgs_lit.method.bounds import SubjectBox, VisualHull
from ghgs_lit.method.bounds.box import RESOLUTION, subject_box
from ghgs_lit.method.bounds.hull import hull_bounds
from ghgs_lit.method.bounds.rays import cut_sides, depths_in_box, dilate, silhouettes, votes_outside
from ghgs_lit.ops.ray_marching import march
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


def voting(batch, **options):
    stage = SubjectBox(**options)
    coarse = silhouettes(batch.masks, batch.cameras, RESOLUTION, stage.dilation)
    return stage._select_voting(coarse).tolist()


def spoil(batch, wrong):
    masks = batch.masks.clone()
    size = masks.shape[2]
    if wrong == "noise":
        masks[0, -1] = torch.rand(masks.shape[2:], generator=torch.Generator().manual_seed(0)) < 0.3
    elif wrong == "half":
        masks[0, -1, size // 2 :] = False
    elif wrong == "one pixel":
        masks[0, -1] = False
        masks[0, -1, 3, 5] = True
    elif wrong == "empty":
        masks[0, -1] = False
    elif wrong == "shifted":
        masks[0, -1] = masks[0, -1].roll(size // 3, -1)
    return dataclasses.replace(batch, masks=masks)


@pytest.mark.parametrize("wrong", ["noise", "half", "one pixel", "shifted"])
@pytest.mark.parametrize("views", [3, 4, 5])
@pytest.mark.parametrize("stage", [SubjectBox(), VisualHull()], ids=["box", "hull"])
def test_one_wrong_mask_cuts_nothing_off(stage, views, wrong):
    """The true surface of the other views lies within their bounds."""
    batch = make_batch(1, views, 112, 112)
    spoiled = spoil(batch, wrong)
    assert voting(spoiled) == [[True] * (views - 1) + [False]]
    found = stage(spoiled)
    seen = batch.masks.clone()
    seen[:, -1] = False
    assert (found.near <= batch.depths)[seen].all()
    assert (found.far >= batch.depths)[seen].all()


#: Views, image size, defect of the last mask, options, and which of the views vote.
VOTES = {
    **{
        f"right masks of {views} views": (views, size, None, {}, [True] * views)
        for views in (2, 3, 4, 5)
        for size in ((56, 56), (140, 98))
    },
    "an empty mask takes no vote away": (4, (56, 56), "empty", {}, [True] * 3 + [False]),
    # with two views it is unknown which one is wrong
    "a half of two": (2, (112, 112), "half", {}, [True, True]),
    "a shifted one of two": (2, (112, 112), "shifted", {}, [True, True]),
    # with a tolerance, its vote alone carves nothing; without it, the others would have to agree
    "an outvoted one": (5, (112, 112), "half", {"tolerance": 1}, [True] * 5),
}


@pytest.mark.parametrize("name", VOTES)
def test_which_masks_vote(name):
    views, size, wrong, options, expected = VOTES[name]
    assert voting(spoil(make_batch(1, views, *size), wrong), **options) == [expected]


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


SCENES = {
    "batch": {"batch": 2, "views": 4, "height": 70, "width": 98},
    "coarse": {"batch": 1, "views": 3, "height": 182, "width": 168},
    "cut": {"batch": 2, "views": 3, "zoom": 1.6},
    "opposite": {"batch": 1, "views": 2},
}


def with_extreme_masks(batch: Batch) -> Batch:
    """Views with an empty mask, a full mask and a mask of a single pixel."""
    masks = batch.masks.clone()
    masks[0, 0] = False
    masks[-1, 1] = True
    if masks.shape[1] > 2:
        masks[-1, 2] = False
        masks[-1, 2, 20, 20] = True
    return dataclasses.replace(batch, masks=masks)


@pytest.mark.parametrize("change", [lambda batch: batch, with_extreme_masks], ids=["clean", "spoiled"])
@pytest.mark.parametrize("tolerance", [0, 1])
@pytest.mark.parametrize("scene", SCENES)
def test_the_kernel_gives_the_bounds_of_plain_pytorch(monkeypatch, scene, tolerance, change):
    batch = change(make_batch(**SCENES[scene]))
    found = VisualHull(tolerance=tolerance)(dataclasses.replace(batch))
    monkeypatch.setitem(march.fits, "cpu", lambda *_: False)
    expected = VisualHull(tolerance=tolerance)(dataclasses.replace(batch))
    assert (found.near != expected.near).float().mean() < 1e-4
    assert (found.far != expected.far).float().mean() < 1e-4
