"""Scene flow against the rigid motion of a painted subject."""

import pytest
import torch

from ghgs_lit.geometry.projection import unproject_maps
from ghgs_lit.geometry.scene_flow import Instant, pyramid, scene_flow
from tests.helpers.motion import INPUTS, instant, motion
from tests.helpers.scenes import CENTER


def flow(moved, shown=None):
    """True and found motions [N, 3] of the surface's points, and their turns."""
    before, after = instant(motion()), instant(moved)
    points = unproject_maps(before.depths, INPUTS)[before.masks]
    if shown is None:
        own = before.masks.flatten(0, 1).nonzero()[:, 0]
        shown = torch.nn.functional.one_hot(own, before.masks.shape[1]).bool()
    true = points @ moved[:3, :3].mT + moved[:3, 3] - points
    found = scene_flow(points, shown, *(Instant(pyramid(b.images[0]), b.cameras[0]) for b in (before, after)))
    return true, *found


@pytest.mark.parametrize("shift", [(0.03, 0.0, 0.0), (0.0, -0.03, 0.0), (0.02, 0.01, -0.03)])
def test_a_shift_is_found_along_every_axis(shift):
    true, found, turned = flow(motion(shift))
    assert (found - true).norm(dim=1).mean() < 0.2 * true.norm(dim=1).mean()
    assert turned.norm(dim=1).mean() < 0.02


def test_a_turn_is_found_with_its_sense():
    true, found, turned = flow(motion(turn=(0.0, 0.1, 0.0)))
    assert (found - true).norm(dim=1).mean() < 0.25 * true.norm(dim=1).mean()
    assert 0.05 < turned.mean(0)[1] < 0.15
    assert turned.mean(0)[[0, 2]].abs().max() < 0.02


def test_photographs_that_do_not_change_move_nothing():
    _, found, turned = flow(motion())
    assert found.abs().max() == turned.abs().max() == 0


def test_other_crops_of_cameras_that_stand_still_move_nothing():
    before = instant(motion())
    lens = INPUTS.intrinsics.clone()
    lens[..., 0, 2] += 5
    cropped = instant(motion(), type(INPUTS)(lens, INPUTS.extrinsics, INPUTS.height, INPUTS.width))
    points = unproject_maps(before.depths, INPUTS)[before.masks]
    shown = torch.ones(len(points), 4, dtype=torch.bool)
    found, _ = scene_flow(
        points, shown, *(Instant(pyramid(b.images[0]), b.cameras[0]) for b in (before, cropped))
    )
    assert found.abs().max() < 2e-3


def test_points_that_no_view_shows_follow_their_neighbours_and_none_stay_where_nothing_is_seen():
    before = instant(motion())
    count = int(before.masks.sum())
    _, found, _ = flow(motion((0.03, 0.0, 0.0)), torch.zeros(count, 4, dtype=torch.bool))
    assert found.abs().max() == 0
    own = before.masks.flatten(0, 1).nonzero()[:, 0]
    shown = torch.nn.functional.one_hot(own, 4).bool()
    hidden = torch.arange(count) % 2 == 1
    shown[hidden] = False
    true, found, _ = flow(motion((0.03, 0.0, 0.0)), shown)
    assert (found - true)[hidden].norm(dim=1).mean() < 0.2 * 0.03


def test_no_points_are_no_error():
    batch = instant(motion())
    one = Instant(pyramid(batch.images[0]), batch.cameras[0])
    moved, turned = scene_flow(torch.zeros(0, 3), torch.zeros(0, 4, dtype=torch.bool), one, one)
    assert moved.shape == turned.shape == (0, 3)


def test_the_origin_of_the_world_does_not_matter_to_the_subjects_middle():
    """The grid begins at the points, wherever they are."""
    true, found, _ = flow(motion((0.03, 0.0, 0.0)))
    assert CENTER.norm() > 0.5
    assert (found - true).norm(dim=1).mean() < 6e-3


def test_strays_and_points_without_a_place_change_nothing_for_others():
    """A depth without bounds may be a kilometre off: a grid up to there would take all memory."""
    before, after = instant(motion()), instant(motion((0.03, 0.0, 0.0)))
    points = unproject_maps(before.depths, INPUTS)[before.masks]
    own = before.masks.flatten(0, 1).nonzero()[:, 0]
    shown = torch.nn.functional.one_hot(own, 4).bool()
    both = [Instant(pyramid(b.images[0]), b.cameras[0]) for b in (before, after)]
    alone, _ = scene_flow(points, shown, *both)
    strays = torch.tensor([[1e3, 0.0, 0.0], [torch.nan, 0.0, 0.0], [0.0, -1e6, 1e6]])
    more, seen = torch.cat((points, strays)), torch.cat((shown, torch.ones(3, 4, dtype=torch.bool)))
    found, _ = scene_flow(more, seen, *both)
    torch.testing.assert_close(found[:-3], alone, rtol=0, atol=1e-6)
    assert found[[-3, -1]].isfinite().all()
