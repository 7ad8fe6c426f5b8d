"""Cameras from silhouettes alone: no model, no colours."""

import dataclasses
import functools

import pytest
import torch

from ghgs_lit.geometry.frame import HEIGHT, Frame
from ghgs_lit.geometry.projection import project, unproject_maps
from ghgs_lit.geometry.rotations import apply_motions, remove_common_motion, rigid
from ghgs_lit.refinement import coherence
from ghgs_lit.refinement.coherence import coherent_cameras, contradiction, culprit
from ghgs_lit.refinement.outlines import Outlines, best_points, gradients_of, rows_of
from ghgs_lit.types import Batch
from tests.helpers.scenes import CENTER, ellipsoid, off, ring

#: A body with two arms and a leg that stick out: centres relative to the subject's, and radii.
PARTS = [
    ((0.0, 0.0, 0.0), (0.25, 0.8, 0.2)),
    ((0.4, 0.3, 0.05), (0.3, 0.07, 0.08)),
    ((-0.1, 0.2, 0.35), (0.08, 0.08, 0.3)),
    ((-0.25, -0.5, -0.1), (0.1, 0.35, 0.1)),
]


def _parts():
    return [(CENTER + torch.tensor(middle), torch.tensor(radii)) for middle, radii in PARTS]


@functools.cache
def figure(batch=1, views=4, size=126):
    """Mattes and depths of the figure, in the subject's frame."""
    cameras = ring(batch, views, size, size)
    finer = [ellipsoid(cameras.resize(4 * size, 4 * size), *part)[0] for part in _parts()]
    alpha = torch.nn.functional.avg_pool2d(torch.stack(finer).any(0).float(), 4)
    found = [ellipsoid(cameras, *part) for part in _parts()]
    masks = torch.stack([mask for mask, _ in found]).any(0)
    depths = torch.stack([torch.where(mask, depth, torch.inf) for mask, depth in found]).amin(0)
    batch = Batch(masks[:, :, None].expand(-1, -1, 3, -1, -1).float(), masks, cameras, alpha=alpha)
    batch = dataclasses.replace(batch, depths=torch.where(masks, depths, 0))
    frame = Frame.of(batch)
    depths = batch.depths / frame.metre.float()[:, None, None, None]
    return dataclasses.replace(frame.enter(batch), depths=depths)


def bump_cameras(truth, off_by, seed):
    """The batch with some cameras (keys) moved by up to the given pixels."""
    poses = truth.cameras.extrinsics.clone()
    for view, pixels in off_by.items():
        poses[:, view] = off(truth, pixels, (seed,)).cameras.extrinsics[:, view]
    return dataclasses.replace(truth, cameras=dataclasses.replace(truth.cameras, extrinsics=poses))


def pixels_off(cameras, truth):
    """Root mean square distance, over all views, between surface points and their true pixels."""
    points = unproject_maps(truth.depths, truth.cameras)[truth.masks][::5]
    seen = [
        project(points.expand(*each.extrinsics.shape[:2], -1, 3), *(m[:, :, None] for m in matrices))[0]
        for each in (cameras, truth.cameras)
        for matrices in [(each.intrinsics, each.extrinsics)]
    ]
    return float((seen[0] - seen[1]).square().sum(-1).mean().sqrt())


@pytest.mark.parametrize(("views", "pixels", "seed"), [(3, 6.0, 1), (4, 6.0, 0), (4, 6.0, 2), (5, 6.0, 3)])
def test_silhouettes_correct_cameras(views, pixels, seed):
    """Errors of pixels become fractions of a pixel; focal lengths hardly change, and rotations stay
    rotations."""
    truth = figure(views=views)
    wrong = off(truth, pixels, (seed,))
    found, _, _ = coherent_cameras(wrong)
    assert pixels_off(found, truth) < 0.5 * pixels_off(wrong.cameras, truth)
    zoom = (found.intrinsics / wrong.cameras.intrinsics)[0, :, [0, 1], [0, 1]]
    torch.testing.assert_close(zoom[:, 0], zoom[:, 1])
    torch.testing.assert_close(zoom, torch.ones_like(zoom), rtol=0, atol=0.04)
    assert torch.equal(found.intrinsics[..., 2], wrong.cameras.intrinsics[..., 2])
    rotation = found.extrinsics[0, :, :3, :3].double()
    torch.testing.assert_close(
        rotation @ rotation.mT, torch.eye(3).double().expand(views, 3, 3), rtol=0, atol=1e-5
    )


@pytest.mark.parametrize("shared", [False, True])
def test_exact_cameras_stay(shared):
    """Consistent silhouettes leave cameras unchanged bit for bit, alone and as a rig."""
    truth = instants() if shared else figure()
    found, _, distance = coherent_cameras(truth, shared=shared)
    assert torch.equal(found.extrinsics, truth.cameras.extrinsics)
    assert torch.equal(found.intrinsics, truth.cameras.intrinsics)
    assert (distance < 5e-4).all()


def second_is_off(pixels):
    """Two elements, the first with exact cameras."""
    truth = figure(batch=2)
    poses = torch.stack((truth.cameras.extrinsics[0], off(truth, pixels, (0, 5)).cameras.extrinsics[1]))
    return dataclasses.replace(truth, cameras=dataclasses.replace(truth.cameras, extrinsics=poses))


def test_distances_tell_exact_cameras_from_others():
    """Distances of the given cameras, in pixels per element, separate exact cameras from others."""
    _, _, distances = coherent_cameras(second_is_off(4.0))
    assert 0 <= distances[0] < 1.5e-4
    assert 3e-3 < distances[1] < 1


def test_a_quick_look_tells_exact_cameras_from_others():
    """The quick check detects cameras off by a pixel or two, per element, and ignores images without an
    outline."""
    batch = second_is_off(3.0)
    exact, wrong = contradiction(batch)[0]
    assert exact < 2e-3 < 4e-3 < wrong
    nothing = dataclasses.replace(batch, masks=batch.masks & False, alpha=0 * batch.alpha)
    assert not any(distances.any() for distances in contradiction(nothing))


def test_half_precision_of_others_changes_nothing():
    """Geometry is in float32 under any autocast."""
    wrong = off(figure(), 6.0, (0,))
    with torch.autocast("cpu", torch.bfloat16):
        found, _, _ = coherent_cameras(wrong)
    assert torch.equal(found.extrinsics, coherent_cameras(wrong)[0].extrinsics)


@pytest.mark.parametrize("matte", [0, 1])
def test_no_outline_at_all_moves_nothing_and_says_nothing(matte):
    """Images without masks must not pass for consistent silhouettes."""
    truth = figure()
    nothing = dataclasses.replace(truth, masks=truth.masks & False, alpha=0 * truth.alpha + matte)
    found, _, distances = coherent_cameras(nothing)
    assert torch.equal(found.extrinsics, truth.cameras.extrinsics)
    assert distances.isposinf().all()


@pytest.mark.parametrize("mask", [torch.zeros(126, 126), torch.ones(126, 126)])
def test_a_silhouette_without_an_outline_says_nothing_wrong(mask):
    """Cameras stay finite with an empty silhouette, which explains no ray, and a full one, which explains
    all."""
    truth = figure()
    alpha = truth.alpha.clone()
    alpha[0, 1] = mask
    found, _, _ = coherent_cameras(dataclasses.replace(truth, alpha=alpha))
    assert found.extrinsics.isfinite().all()
    if mask.all():
        assert torch.equal(found.extrinsics, truth.cameras.extrinsics)


def test_a_subject_may_go_on_beyond_a_photograph():
    """An image that cuts off the legs contradicts nothing, since it shows nothing below its border."""
    truth = figure()
    cameras = dataclasses.replace(truth.cameras, height=90)
    images, masks, alpha = (part[..., :90, :] for part in (truth.images, truth.masks, truth.alpha))
    cut = Batch(images, masks, cameras, alpha=alpha)
    assert cut.masks[..., -1, :].any()
    assert torch.equal(coherent_cameras(cut)[0].extrinsics, truth.cameras.extrinsics)


def test_gradients_are_those_of_finite_differences():
    """Derivatives of distances with respect to points, in a smooth map (a cone, whose slopes are
    constant)."""
    truth = figure()
    lens, pose = truth.cameras.intrinsics[0], truth.cameras.extrinsics[0]
    u, v = torch.meshgrid(torch.arange(4 * 126.0), torch.arange(4 * 126.0), indexing="xy")
    ramps = torch.stack([a * u + b * v for a, b in ((0.1, 0.0), (0.0, 0.1), (0.05, 0.1), (0.1, -0.02))])
    outlines = Outlines(ramps[:, None], None, None, None, (126, 126))
    points = 0.3 * torch.randn(40, 3, generator=torch.Generator().manual_seed(2))
    other = torch.arange(40) % 4
    gradients = gradients_of(outlines, lens, pose, points, other)
    # a rotation is about the frame's origin, not about the subject
    middle = torch.tensor([0.2, -0.1, 0.3])
    rows = rows_of(points, gradients, pose[other], middle)

    def distances(step):
        rotation, shift = rigid(step[:6], HEIGHT / 2)
        zoomed = lens.clone()
        zoomed[:, [0, 1], [0, 1]] *= step[6].exp()
        moved = (points + middle) @ rotation.mT + shift - middle
        return outlines.at(other, project(moved, zoomed[other], pose[other])[0])

    for axis in range(7):
        step = 0.01 * torch.eye(7)[axis]
        found = (distances(step) - distances(-step)) / 0.02
        torch.testing.assert_close(rows[:, axis], found, rtol=0.02, atol=0.05)


def test_a_step_follows_the_motion_that_took_cameras_away(monkeypatch):
    """One camera moves sideways by six pixels, less the common motion: most of it is undone.

    Silhouettes cannot distinguish this from one camera that moved alone, so none may stay here.
    """
    truth = figure()
    pose = truth.cameras.extrinsics[0]
    motion = torch.zeros(4, 6)
    motion[2, 3:] = 6 * pose[2, 2, 3] / truth.cameras.intrinsics[0, 2, 0, 0] / (HEIGHT / 2) * pose[2, 0, :3]
    motion = remove_common_motion(motion, pose[:, 2, :3])
    moved = apply_motions(pose, motion, torch.zeros(3), HEIGHT / 2)[None]
    wrong = dataclasses.replace(truth, cameras=dataclasses.replace(truth.cameras, extrinsics=moved))
    monkeypatch.setattr(coherence, "_minority", lambda *_: None)
    found, _, _ = coherent_cameras(wrong)
    assert pixels_off(found, truth) < 0.5 * pixels_off(wrong.cameras, truth)


@pytest.mark.parametrize(
    ("views", "off_by", "seed"),
    [(3, {1: 10}, 4), (4, {1: 6}, 0), (4, {2: 10}, 4), (5, {1: 6, 3: 8}, 2), (4, {2: 2.5}, 4)],
)
def test_a_minority_that_explains_all_moves_alone(views, off_by, seed):
    """Cameras that agree with one another are right; of five, two may be off."""
    truth = figure(views=views)
    wrong = bump_cameras(truth, off_by, seed)
    found, free, _ = coherent_cameras(wrong)
    assert free.tolist() == [[view in off_by for view in range(views)]]
    for name in ("intrinsics", "extrinsics"):
        before, after = (getattr(cameras, name)[~free] for cameras in (wrong.cameras, found))
        assert torch.equal(before, after)
    share = 0.8 if off_by == {2: 2.5} else 0.7
    assert pixels_off(found, truth) < share * pixels_off(wrong.cameras, truth)


@pytest.mark.parametrize("views", [3, 4, 5])
def test_where_all_are_off_all_move(views):
    truth = figure(views=views)
    _, free, _ = coherent_cameras(off(truth, 6.0, (1,)))
    assert free.all()


def test_a_clear_culprit_is_named_and_one_of_two_is_not():
    """Without either of two opposite cameras, the others may agree equally well."""
    assert culprit([0.003, 1e-5, 0.002, 0.004]) == 1
    assert culprit([0.003, 8e-4, 0.002, 9e-4]) is None
    assert culprit([2e-5, 0.0, 3e-5, 1e-5]) is None


def with_zooms(truth, zooms):
    lens = truth.cameras.intrinsics.clone()
    lens[..., [0, 1], [0, 1]] *= zooms[:, None]
    return dataclasses.replace(truth, cameras=dataclasses.replace(truth.cameras, intrinsics=lens))


@pytest.mark.parametrize("zoomed", [1, 3])
def test_a_wrong_focal_length_comes_back(zoomed):
    """One focal length is too long: the others agree without it, and stay."""
    truth = figure()
    wrong = with_zooms(truth, torch.ones(4).index_fill(0, torch.tensor([zoomed]), 1.06))
    found, free, _ = coherent_cameras(wrong)
    assert free[0].nonzero().tolist() == [[zoomed]]
    assert pixels_off(found, truth) < 0.4 * pixels_off(wrong.cameras, truth)


def test_focal_lengths_that_contradict_one_another_come_nearer(monkeypatch):
    """All focal lengths are off: their observable part is recovered, and is not mistaken for a motion."""
    truth = figure()
    zoom = torch.tensor([1.0, 1.06, 1.0, 1.0])
    zoom = zoom / zoom.log().mean().exp()  # a common zoom is not observable
    wrong = with_zooms(truth, zoom)
    monkeypatch.setattr(coherence, "_minority", lambda *_: None)
    found, _, _ = coherent_cameras(wrong)
    left = (found.intrinsics / truth.cameras.intrinsics)[0, :, 0, 0].log()
    assert left.abs().max() < 0.7 * zoom.log().abs().max()
    assert pixels_off(found, truth) < 0.5 * pixels_off(wrong.cameras, truth)


def test_a_ray_is_looked_up_in_the_other_silhouettes():
    """The depth is the least one in the other silhouettes, and no other point of the ray exceeds it."""
    truth = figure()
    outlines = Outlines.of(truth.alpha[0])
    lens, pose = truth.cameras.intrinsics[0], truth.cameras.extrinsics[0]
    view, pixels = outlines.view[::23], outlines.pixels[::23]
    points, other, depth = best_points(outlines, lens, pose, view, pixels)
    assert (other != view).all()
    index = torch.arange(4).expand(len(view), 4)
    seen = project(points[:, None].expand(-1, 4, 3), lens[index], pose[index])[0]
    torch.testing.assert_close(seen[torch.arange(len(view)), view], pixels, rtol=0, atol=1e-3)
    depths = torch.where(index == view[:, None], torch.inf, outlines.at(index, seen))
    torch.testing.assert_close(depths.amin(1), depth)
    # With exact cameras all of them meet the others, up to the sampling of depths.
    assert depth.min() > -0.5


def test_phases_weigh_rays_by_what_they_make_small():
    """First only rays that miss have weight, then only those about as deep as in their own silhouette."""
    first, second = coherence._MEET, coherence._LIE
    depth = torch.tensor([3.0, -0.5, -4.0])
    distances = first.distances(depth, torch.ones(3))
    torch.testing.assert_close(distances, torch.tensor([0.0, -0.5, -4.0]))
    torch.testing.assert_close(first.weights(distances), torch.tensor([0.0, 1.0, 0.25]))
    distances = second.distances(torch.tensor([2.0, 1.7, 5.0]), torch.full((3,), 2.0))
    torch.testing.assert_close(distances, torch.tensor([0.0, -0.3, 3.0]))
    weights = second.weights(distances)
    assert weights[0] == 1
    assert 0.2 < weights[1] < 0.3
    assert weights[2] < 1e-3


def instants(count=3, views=4, size=98):
    """The figure at several positions in one world, as elements of a batch in one frame."""
    cameras, found = ring(1, views, size, size), []
    for number in range(count):
        moved = torch.eye(4)
        moved[:3, 3] = torch.tensor([0.15 * number, 0.0, -0.1 * number])
        place = dataclasses.replace(cameras, extrinsics=cameras.extrinsics @ moved)
        parts = [ellipsoid(place.resize(4 * size, 4 * size), *part)[0] for part in _parts()]
        found.append(torch.nn.functional.avg_pool2d(torch.stack(parts).any(0).float(), 4))
    alpha = torch.cat(found)
    lens, pose = (
        matrix.expand(count, -1, -1, -1).clone() for matrix in (cameras.intrinsics, cameras.extrinsics)
    )
    masks, cameras = alpha > 0.5, dataclasses.replace(cameras, intrinsics=lens, extrinsics=pose)
    batch = Batch(masks[:, :, None].expand(-1, -1, 3, -1, -1).float(), masks, cameras, alpha=alpha)
    return Frame.of(batch).shared.enter(batch)


def corners_off(cameras, truth):
    """Root mean square error in pixels of a box around all instants, in the first instant's views."""
    corners = HEIGHT / 3 * torch.cartesian_prod(*[torch.tensor([-1.0, 1.0])] * 3)
    seen = [
        project(corners.expand(4, -1, -1), each.intrinsics[0][:, None], each.extrinsics[0][:, None])[0]
        for each in (cameras, truth)
    ]
    return float((seen[0] - seen[1]).square().sum(-1).mean().sqrt())


def test_instants_of_one_rig_move_its_cameras_alike_and_tell_more_than_one():
    truth = instants()
    wrong = dataclasses.replace(truth, cameras=off(truth, 6.0, (2,) * 3).cameras)
    pose = wrong.cameras.extrinsics[:1].expand(3, -1, -1, -1)
    wrong = dataclasses.replace(wrong, cameras=dataclasses.replace(truth.cameras, extrinsics=pose))
    found, free, distance = coherent_cameras(wrong, shared=True)
    assert (found.extrinsics == found.extrinsics[:1]).all()
    assert (found.intrinsics == found.intrinsics[:1]).all()
    assert free.all()
    assert distance.unique().numel() == 1
    alone, _, _ = coherent_cameras(wrong)
    before, together, each = (corners_off(c, truth.cameras) for c in (wrong.cameras, found, alone))
    assert together < 0.5 * before
    assert together < 0.85 * each
