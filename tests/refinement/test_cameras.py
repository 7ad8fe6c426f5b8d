"""Refinement of a capture's cameras: corrected where images disagree, otherwise unchanged."""

import dataclasses

import numpy as np
import pytest
import torch

from ghgs_lit.errors import InputError
from ghgs_lit.evaluation.baselines import splats_at
from ghgs_lit.geometry.frame import Frame
from ghgs_lit.geometry.projection import project, unproject_maps
from ghgs_lit.refinement import CameraRefinement, pixels_moved
from ghgs_lit.refinement.cameras import _views
from ghgs_lit.rendering import Renderer
from ghgs_lit.types import Batch
from tests.helpers.scenes import off, painted_ellipsoid, ring

RENDERER = Renderer(backend="cpu")


@dataclasses.dataclass
class Splats:
    """Stand-in for a model that knows the true depths and predicts with the cameras it is given."""

    gaussians: object
    depth: object


def predictor(truth):
    """Splats at the true depth along the rays of each image, in the subject's frame of 1.8 m."""
    depths = (truth.depths.double() / Frame.of(truth).metre[:, None, None, None]).float()
    return lambda batch: Splats(splats_at(batch, depths, batch.masks, sigma=0.5), depths)


def scene(batch=1, views=4, size=70):
    """Images of textured ellipsoids with their depths."""
    cameras = ring(batch, views, size, size)
    images, masks, depths = painted_ellipsoid(cameras)
    return Batch(images, masks, cameras, depths=depths)


def far_away(batch):
    """The same scene in millimetres, kilometres from the world's origin."""
    poses = batch.cameras.extrinsics.double().clone()
    poses[..., :3, 3] *= 1000
    poses[..., :3, 3] -= poses[..., :3, :3] @ torch.tensor([3e6, 2e5, -1e6], dtype=torch.float64)
    cameras = dataclasses.replace(batch.cameras, extrinsics=poses)
    return dataclasses.replace(batch, cameras=cameras, depths=None)


def contradiction(batch, truth):
    """Reprojection error in pixels of surface points, triangulated from their true pixels."""
    points = unproject_maps(truth.depths, truth.cameras)[truth.masks].double()[::7]
    lens, pose = truth.cameras.intrinsics[0, :, None].double(), truth.cameras.extrinsics[0, :, None].double()
    lenses, poses = (
        batch.cameras.intrinsics[0, :, None].double(),
        batch.cameras.extrinsics[0, :, None].double(),
    )

    def seen(points, lens, pose):
        shape = (len(lens), len(points))
        return project(points.expand(*shape, 3), lens.expand(*shape, 3, 3), pose.expand(*shape, 4, 4))[0]

    true = seen(points, lens, pose)
    rays = torch.cat((true, torch.ones_like(true[..., :1])), -1) @ torch.linalg.inv(lenses[:, 0]).mT
    rays = torch.nn.functional.normalize(rays @ poses[:, 0, :3, :3], dim=-1)
    centers = -(poses[:, 0, :3, :3].mT @ poses[:, 0, :3, 3:])[:, None]
    across = torch.eye(3).double() - rays[..., :, None] * rays[..., None, :]
    found = torch.linalg.solve(across.sum(0), (across @ centers).sum(0))[..., 0]
    return float((seen(found, lenses, poses) - true).square().sum(-1).mean().sqrt())


@pytest.mark.parametrize(("views", "pixels", "seed"), [(3, 4.0, 2), (4, 2.0, 0), (4, 2.0, 1)])
def test_views_agree_better(views, pixels, seed):
    """The rig as a whole may keep its errors, but its cameras must fit one another.

    Three views, a third of a turn apart, share little surface: only large errors are visible.
    """
    truth = scene(views=views)
    wrong = off(truth, pixels, (seed,))
    found = CameraRefinement(4, predictor(truth), RENDERER)(wrong)
    assert contradiction(found, truth) < 0.6 * contradiction(wrong, truth)
    torch.testing.assert_close(found.cameras.intrinsics, wrong.cameras.intrinsics, rtol=0.02, atol=0)
    rotation = found.cameras.extrinsics[0, :, :3, :3].double()
    identity = torch.eye(3).double().expand(views, 3, 3)
    # Four rotations in float32: each rounds nine entries, of which a product takes six.
    limit = 4 * 6 * torch.finfo(torch.float32).eps
    torch.testing.assert_close(rotation @ rotation.mT, identity, rtol=0, atol=limit)
    assert max(pixels_moved(wrong, found)[0]) > 0.3


def test_focal_lengths_are_corrected_where_silhouettes_tell_them():
    """One element has a focal length that is too long, the other none: only the first one's lenses change."""
    truth = scene(batch=2)
    lenses = truth.cameras.intrinsics.clone()
    lenses[0, 1, [0, 1], [0, 1]] *= 1.08
    wrong = dataclasses.replace(truth, cameras=dataclasses.replace(truth.cameras, intrinsics=lenses))
    found = CameraRefinement(1, predictor(truth), RENDERER)(wrong).cameras.intrinsics
    assert torch.equal(found[1], truth.cameras.intrinsics[1])

    def beside_one_another(lens):
        zoom = (lens / truth.cameras.intrinsics)[0, :, 0, 0].log()
        return zoom - zoom.mean()

    assert beside_one_another(found).abs().max() < 0.8 * beside_one_another(lenses).abs().max()


def test_exact_cameras_stay():
    """Refining exact cameras must not lose accuracy, not even digits far from the world's origin."""
    truth = scene()
    for batch in (truth, far_away(truth)):
        found = CameraRefinement(2, predictor(truth), RENDERER)(batch)
        assert torch.equal(found.cameras.extrinsics, batch.cameras.extrinsics)
    assert contradiction(truth, truth) < 1e-4


@pytest.mark.parametrize("is_exact", [False, True])
def test_elements_are_corrected_as_if_alone(is_exact):
    """The result does not depend on batch mates, whether their cameras are exact or not."""
    truth = scene(batch=2, size=42)
    wrong = off(truth, seeds=(0, 5))
    if is_exact:
        poses = torch.stack((truth.cameras.extrinsics[0], wrong.cameras.extrinsics[1]))
        wrong = dataclasses.replace(wrong, cameras=dataclasses.replace(wrong.cameras, extrinsics=poses))
    together = CameraRefinement(6, predictor(truth), RENDERER)(wrong)
    stays = [max(moved) == 0 for moved in pixels_moved(wrong, together)]
    assert stays == [is_exact, False]
    for b in range(2):
        one = Batch(wrong.images[[b]], wrong.masks[[b]], wrong.cameras[[b]])
        own = Batch(truth.images[[b]], truth.masks[[b]], truth.cameras[[b]], depths=truth.depths[[b]])
        alone = CameraRefinement(6, predictor(own), RENDERER)(one)
        torch.testing.assert_close(
            alone.cameras.extrinsics[0], together.cameras.extrinsics[b], rtol=0, atol=2e-5
        )


@pytest.mark.parametrize("views", [3, 4])
def test_cameras_that_silhouettes_agree_with_need_more_to_be_moved(monkeypatch, views):
    """The first element has exact cameras, the others' are off by pixels; three views constrain them less."""
    truth = scene(batch=2, views=views)
    poses = torch.stack((truth.cameras.extrinsics[0], off(truth, 4.0, (0, 5)).cameras.extrinsics[1]))
    batch = dataclasses.replace(truth, cameras=dataclasses.replace(truth.cameras, extrinsics=poses))
    asked = []

    def corrected(self, prediction, batch, free, worth):
        asked.append(worth)
        return batch.cameras, torch.zeros(2, dtype=torch.bool)

    monkeypatch.setattr(CameraRefinement, "_correct", corrected)
    CameraRefinement(1, predictor(truth), RENDERER)(batch)
    assert asked[0].min() > 0
    assert bool(asked[0][0] > 2 * asked[0][1]) == (views == 4)


def test_a_camera_that_was_bumped_moves_alone():
    """Three of four cameras are exact: they stay bit for bit, and the fourth's error is not spread over
    them."""
    truth = scene()
    poses = truth.cameras.extrinsics.clone()
    poses[:, 1] = off(truth, 8.0, (4,)).cameras.extrinsics[:, 1]
    wrong = dataclasses.replace(truth, cameras=dataclasses.replace(truth.cameras, extrinsics=poses))
    found = CameraRefinement(4, predictor(truth), RENDERER)(wrong)
    moved = pixels_moved(wrong, found)[0]
    assert [value > 0 for value in moved] == [False, True, False, False]
    assert moved[1] > 3
    assert pixels_moved(truth, found)[0][1] < 0.5 * pixels_moved(truth, wrong)[0][1]
    assert contradiction(found, truth) < 0.3 * contradiction(wrong, truth)


def test_rounds_end_where_nothing_gets_better():
    """Consistent cameras take one prediction, others as many as help."""
    truth = scene(size=42)
    counts = []
    for batch in (truth, off(truth)):
        calls = []
        predict = predictor(truth)
        CameraRefinement(12, lambda seen, p=predict, c=calls: c.append(1) or p(seen), RENDERER)(batch)
        counts.append(len(calls))
    assert counts[0] == 1 < counts[1] < 12


def test_any_unit_and_origin():
    """Millimetres and a far origin give the same motion in pixels."""
    truth = scene(size=42)
    wrong = off(truth)
    expected = pixels_moved(wrong, CameraRefinement(1, predictor(truth), RENDERER)(wrong))
    moved = far_away(wrong)
    # The refinement predicts in the subject's frame, in which lengths are the same.
    found = CameraRefinement(1, predictor(truth), RENDERER)(moved)
    assert found.cameras.extrinsics.dtype == torch.float64
    np.testing.assert_allclose(pixels_moved(moved, found), expected, atol=0.05)


def test_no_rounds_are_refused():
    with pytest.raises(InputError, match="refine_cameras: expected 1 or more rounds"):
        CameraRefinement(0, predictor(scene(size=28)), RENDERER)


def test_a_view_is_compared_with_what_the_other_views_of_its_element_say():
    """A view's own Gaussians are left out, since they reproduce its image wherever its camera is."""
    truth = scene(batch=2, views=3, size=28)
    inside = Frame.of(truth).enter(truth)
    views = _views(predictor(truth)(inside), inside)
    assert set(views.owner.tolist()) == set(range(6))
    for view in range(6):
        shown = set(views.gaussians.image[views.owner == view].tolist())
        assert shown == {3 * (view // 3) + other for other in range(3)} - {view}
