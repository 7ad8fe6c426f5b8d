"""Instants that start from the last: they follow, and begin anew where they must."""

import dataclasses
import itertools

import pytest
import torch

from ghgs_capture.temporal import Temporal
from ghgs_lit.metrics.functional import psnr
from ghgs_lit.rendering import Renderer
from ghgs_lit.types import Cameras
from tests.helpers.motion import BETWEEN, INPUTS, at_true_depth, instant, motion, photographed

RENDERER = Renderer(backend="cpu")


def counted():
    """A prediction that notes the batches that it is asked for."""
    asked = []

    def predict(batch):
        asked.append(batch)
        return at_true_depth(batch)

    return predict, asked


def quality(prediction, moved):
    image = RENDERER(prediction.gaussians, BETWEEN).image[0]
    return float(psnr(image.clamp(0, 1), photographed(BETWEEN, moved)[0][0]).mean())


def steps(count):
    """A subject that walks and turns."""
    return [motion((0.006 * n, 0.0, 0.004 * n), (0.0, 0.02 * n, 0.0)) for n in range(count)]


def test_gaussians_follow_the_subject_without_another_prediction():
    predict, asked = counted()
    temporal = Temporal(predict, 99, RENDERER)
    found = [temporal(instant(moved)) for moved in steps(6)]
    assert len(asked) == temporal.anew == 1
    for prediction, moved in zip(found[1:], steps(6)[1:], strict=True):
        by_itself = quality(at_true_depth(instant(moved)), moved)
        assert quality(prediction, moved) > by_itself - 1.0
    assert quality(found[0], steps(6)[5]) < quality(found[5], steps(6)[5]) - 2


def test_depths_and_points_are_those_of_the_instant():
    temporal = Temporal(at_true_depth, 99, RENDERER)
    *_, last = (temporal(instant(moved)) for moved in steps(4))
    batch = instant(steps(4)[3])
    assert torch.equal(last.depth_valid, batch.masks)
    assert (last.depth > 0).all()
    off = (last.depth - batch.depths)[last.depth_valid].abs()
    assert off.median() < 0.03  # these splats are round: one sees through to what lies behind
    assert torch.equal(last.depth_valid, last.points.valid)


def test_an_instant_that_equals_the_last_has_the_same_bits():
    predict, asked = counted()
    temporal = Temporal(predict, 99, RENDERER)
    first, second, third = (temporal(instant(motion())) for _ in range(3))
    assert first is second is third
    assert len(asked) == 1


@pytest.mark.parametrize("every", [1, 3])
def test_every_so_many_instants_one_is_predicted_anew(every):
    predict, asked = counted()
    temporal = Temporal(predict, every, RENDERER)
    for moved in steps(7):
        temporal(instant(moved))
    assert temporal.anew == len(asked) == (7 if every == 1 else 3)


def test_every_instant_by_itself_is_the_prediction_as_it_is():
    temporal, batch = Temporal(at_true_depth, 1, RENDERER), instant(motion())
    assert torch.equal(temporal(batch).gaussians.means, at_true_depth(batch).gaussians.means)
    assert temporal(batch) is not temporal(batch)


def test_a_jump_is_predicted_anew():
    """And what comes next, too, before it is followed again: more jumps cost no attempt each."""
    predict, asked = counted()
    temporal = Temporal(predict, 99, RENDERER)
    for shift in (0.0, 0.005, 0.5, 0.505, 0.51):
        last = temporal(instant(motion((shift, 0.0, 0.0))))
    assert [float(b.depths.max()) for b in asked] == [
        float(instant(motion((shift, 0.0, 0.0))).depths.max()) for shift in (0.0, 0.5, 0.505)
    ]
    there = motion((0.51, 0.0, 0.0))
    assert quality(last, there) > quality(at_true_depth(instant(there)), there) - 1


def test_a_camera_that_is_missing_for_an_instant_is_predicted_without_it_and_with_it_again():
    predict, asked = counted()
    temporal = Temporal(predict, 99, RENDERER)
    whole = [instant(moved) for moved in steps(4)]
    for batch in (whole[0], whole[1].of_views([0, 1, 3]), whole[2].of_views([0, 1, 3]), whole[3]):
        temporal(batch)
    assert [b.masks.shape[1] for b in asked] == [4, 3, 4]


def test_crops_that_move_are_no_motion():
    """The crop of each instant is another part of what its camera sees."""
    moved = INPUTS.intrinsics.clone()
    moved[..., 0, 2] += 6
    crops = dataclasses.replace(INPUTS, intrinsics=moved)
    temporal = Temporal(at_true_depth, 99, RENDERER)
    first, second = temporal(instant(motion())), temporal(instant(motion(), crops))
    assert temporal.anew == 1
    assert (second.gaussians.means - first.gaussians.means).norm(dim=1).mean() < 0.02


def test_what_was_forgotten_is_predicted_anew():
    predict, asked = counted()
    temporal = Temporal(predict, 99, RENDERER)
    temporal(instant(motion()))
    temporal.reset()
    temporal(instant(motion()))
    assert len(asked) == 2


def test_unit_and_origin_of_the_world_do_not_matter():
    """A world in millimetres, a kilometre away."""
    shift = torch.tensor([1e3, -5e2, 2e2], dtype=torch.float64)

    def elsewhere(batch):
        extrinsics = batch.cameras.extrinsics.double().clone()
        extrinsics[..., :3, 3] -= (extrinsics[..., :3, :3] @ shift[:, None])[..., 0]
        extrinsics[..., :3, 3] *= 1e3
        cameras = Cameras(
            batch.cameras.intrinsics.double(), extrinsics, batch.cameras.height, batch.cameras.width
        )
        return dataclasses.replace(batch, cameras=cameras)

    def predict(batch):
        found = at_true_depth(dataclasses.replace(batch, cameras=instant(motion()).cameras))
        g = found.gaussians
        means = 1e3 * (g.means.double() + shift)
        g = dataclasses.replace(g, means=means, scales=1e3 * g.scales, metre=torch.tensor([1e3]))
        return dataclasses.replace(found, gaussians=g)

    here, there = Temporal(at_true_depth, 99, RENDERER), Temporal(predict, 99, RENDERER)
    for moved in steps(3):
        one, other = here(instant(moved)), there(elsewhere(instant(moved)))
    assert there.anew == 1
    back = other.gaussians.means / 1e3 - shift
    assert (back - one.gaussians.means).abs().mean() < 1e-4


def test_a_mask_that_loses_a_part_is_predicted_anew_and_so_is_what_comes_next():
    """What a mask takes no longer for the subject is in no error within masks."""
    predict, asked = counted()
    temporal = Temporal(predict, 99, RENDERER)
    whole = [instant(moved) for moved in steps(5)]
    rows = whole[2].masks[0, 0].any(1).nonzero()
    lost = whole[2].masks.clone()
    lost[0, 0, : int(rows[len(rows) // 4])] = False
    whole[2] = dataclasses.replace(
        whole[2], images=whole[2].images * lost[:, :, None], masks=lost, depths=whole[2].depths * lost
    )
    for batch in whole:
        found = temporal(batch)
    assert [int(b.masks.sum()) for b in asked] == [int(whole[n].masks.sum()) for n in (0, 2, 3)]
    assert quality(found, steps(5)[4]) > quality(at_true_depth(whole[4]), steps(5)[4]) - 1.0


def test_a_person_who_leaves_and_comes_back():
    """Nobody is no Gaussians, once; who comes back elsewhere is predicted anew and
    followed again."""
    predict, asked = counted()
    temporal = Temporal(predict, 99, RENDERER)
    back = [motion((0.3 + 0.005 * n, 0.0, -0.2)) for n in range(3)]
    here, there = [instant(moved) for moved in steps(2)], [instant(moved) for moved in back]
    gone = dataclasses.replace(
        here[0],
        images=torch.zeros_like(here[0].images),
        masks=torch.zeros_like(here[0].masks),
        depths=torch.zeros_like(here[0].depths),
    )
    found = [temporal(batch) for batch in (*here, gone, gone, *there)]
    assert [len(prediction.gaussians) > 0 for prediction in found] == [True] * 2 + [False] * 2 + [True] * 3
    assert [int(b.masks.sum()) for b in asked] == [int(b.masks.sum()) for b in (here[0], gone, there[0])]
    assert quality(found[-1], back[-1]) > quality(at_true_depth(there[-1]), back[-1]) - 1.0


def test_a_camera_that_is_black_for_three_instants():
    """Although its masks say nothing of it. They are predicted from what there is, and so is what
    comes next; nothing of them is handed on."""
    predict, asked = counted()
    temporal = Temporal(predict, 99, RENDERER)
    batches = [instant(moved) for moved in steps(8)]
    for number in (2, 3, 4):
        images = batches[number].images.clone()
        images[:, 1] = 0
        batches[number] = dataclasses.replace(batches[number], images=images)
    for batch in batches:
        found = temporal(batch)
    numbers = [[torch.equal(one.images, b.images) for one in batches].index(True) for b in asked]
    assert numbers == [0, 2, 3, 5, 6]
    assert quality(found, steps(8)[7]) > quality(at_true_depth(batches[7]), steps(8)[7]) - 1.0


def with_brightness(brightness):
    """A prediction whose colours are off by the next of some values each time."""
    values = iter(brightness)

    def predict(batch):
        found, off = at_true_depth(batch), next(values)
        colors = found.gaussians.colors + off
        return dataclasses.replace(found, gaussians=dataclasses.replace(found.gaussians, colors=colors))

    return predict


def brightness_of(gaussians, moved):
    """Mean difference of a render's colours from the photograph's."""
    photographs, masks, _ = photographed(BETWEEN, moved)
    drawn = RENDERER(gaussians, BETWEEN).image[0]
    return float((drawn - photographs[0])[masks[0, :, None].expand_as(drawn)].mean())


def test_a_new_prediction_takes_the_place_of_the_last_one_over_some_instants():
    """None of them shows more than half of the difference; those of before are gone after four."""
    temporal = Temporal(with_brightness((0.1, -0.1)), 6, RENDERER)
    found = [temporal(instant(moved)).gaussians for moved in steps(11)]
    before, *errors = [brightness_of(found[number], steps(11)[number]) for number in range(5, 11)]
    at_once = Temporal(with_brightness((-0.1,)), 6, RENDERER)(instant(steps(7)[6])).gaussians
    counts = [int(instant(moved).masks.sum()) for moved in steps(7)]
    assert temporal.anew == 2
    assert [len(gaussians) for gaussians in found[6:]] == [counts[6] + counts[0]] * 4 + [counts[6]]
    pop = before - brightness_of(at_once, steps(7)[6])
    changes = [first - second for first, second in itertools.pairwise([before, *errors])]
    assert max(changes) < 0.5 * pop


@pytest.mark.parametrize("every", [2, 3])
def test_predictions_that_follow_one_another_quickly_do_not_pile_up(every):
    temporal = Temporal(at_true_depth, every, RENDERER)
    counts = [len(temporal(instant(moved)).gaussians) for moved in steps(3 * every)]
    whole = int(instant(steps(1)[0]).masks.sum())
    assert max(counts) == pytest.approx(2 * whole, rel=0.05)
    assert counts[every - 1 :: every] == pytest.approx([whole] * 3, rel=0.05)


def test_a_jump_when_a_new_prediction_is_due_leaves_nothing_behind():
    temporal = Temporal(at_true_depth, 3, RENDERER)
    for shift in (0.0, 0.005, 0.01, 0.5):
        found = temporal(instant(motion((shift, 0.0, 0.0))))
    assert len(found.gaussians) == int(instant(motion((0.5, 0.0, 0.0))).masks.sum())
