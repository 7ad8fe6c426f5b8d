"""Masks of one instant are compared with the others' hull, and corrected if they fail."""

import dataclasses

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from ghgs_capture.agreement import MISSED, Agreement
from ghgs_capture.backgrounds import Backgrounds
from ghgs_capture.capture import Capture
from ghgs_capture.crops import Photograph, shrink
from tests.helpers.figures import Figure

COUNT = 8


def figure(views=4, **options):
    return Figure(views=views, height=256, width=192, **options)


def capture(of, name="0", seed=None, masks=None, shift=0):
    """An instant of a figure, moved sideways in each photograph, in front of a patterned background."""
    photographs = []
    for view, camera in enumerate(of.names):
        rng = np.random.default_rng(view)
        behind = 110 + 300 * gaussian_filter(rng.normal(0, 1, (*of.masks[view].shape, 1)), (3, 3, 0))
        noise = np.random.default_rng([view, seed or 0]).normal(0, 2, of.images[view].shape)
        mask = np.roll(of.masks[view], shift, 1)
        image = np.where(mask[..., None], np.roll(of.images[view], shift, 1), behind) + noise
        shown = mask if masks is None else masks[view]
        lens, pose = (np.array(of.cameras[camera][key]) for key in ("intrinsics", "extrinsics"))
        lens[0, 2] += shift
        matte = shown * np.uint8(255)
        photographs.append(Photograph(camera, image.clip(0, 255).astype(np.uint8), matte, lens, pose))
    return Capture(name, tuple(photographs))


def without_head(mask):
    """The mask without its upper fifth."""
    rows = np.nonzero(mask.any(1))[0]
    cut = mask.copy()
    cut[: int(rows[0] + 0.2 * len(rows))] = False
    return cut


@pytest.mark.parametrize("options", [{}, {"scale": 1000.0, "origin": (1e5, -2e5, 3e5)}])
def test_masks_of_one_subject_agree(options):
    """In any unit of length and at any position in the world."""
    agreement = Agreement.of(capture(figure(**options)))
    assert max(agreement.misses) < MISSED / 2
    assert not agreement.failed.any()


def test_a_mask_that_lacks_a_part_takes_it_from_the_others():
    of = figure()
    masks = [*of.masks]
    masks[2] = without_head(masks[2])
    agreement = Agreement.of(capture(of, masks=masks))
    assert agreement.misses[2] < MISSED
    assert np.argmax(agreement.takes) == 2
    assert agreement.failed[2]
    # Without its view the others agree.
    assert max(agreement.outside(view, (2,)) for view in (0, 1, 3)) < MISSED


def test_a_mask_that_shows_more_is_outside_of_the_others_hull():
    of = figure()
    masks = [mask.copy() for mask in of.masks]
    masks[1][20:60, 5:40] = True
    agreement = Agreement.of(capture(of, masks=masks))
    assert np.argmax(agreement.misses) == 1
    assert agreement.failed[1]
    assert max(agreement.outside(view, (1,)) for view in (0, 2, 3)) < MISSED


def test_two_masks_say_nothing():
    assert Agreement.of(capture(figure(views=2))) is None


def test_what_a_photograph_cuts_is_not_missed():
    """A mask contains no information beyond a border of the photograph that cuts the subject."""
    of = figure()
    given = capture(of)
    first = given.photographs[0]
    top = first.extents[0][0] + 30
    lens = first.intrinsics - np.array([[0, 0, 0], [0, 0, top], [0, 0, 0]])
    cut = dataclasses.replace(first, image=first.image[top:], matte=first.matte[top:], intrinsics=lens)
    agreement = Agreement.of(dataclasses.replace(given, photographs=(cut, *given.photographs[1:])))
    assert not agreement.failed.any()


def test_masks_that_fail_are_mended_and_the_others_stay(monkeypatch):
    """A head is missing in one mask in half of the instants, and another mask includes an object."""
    of = figure()
    instants = []
    for number in range(COUNT):
        right = [np.roll(mask, 6 * number - 20, 1) for mask in of.masks]
        masks = [*right]
        if number >= COUNT // 2:
            masks[2] = without_head(masks[2])
        if number == COUNT - 1:
            masks[0] = masks[0].copy()
            masks[0][200:240, 5:35] = True
        instants.append((right, capture(of, str(number), number, masks, 6 * number - 20)))
    backgrounds = Backgrounds.of([instant for _, instant in instants])
    rounds = []
    mend = Backgrounds._mend

    def spy(self, capture, agreement):
        rounds.append((capture.photographs, agreement.photographs))
        return mend(self, capture, agreement)

    monkeypatch.setattr(Backgrounds, "_mend", spy)
    for number, (right, instant) in enumerate(instants):
        mended = backgrounds.apply(instant)
        wrong = {2} if number >= COUNT // 2 else set()
        wrong |= {0} if number == COUNT - 1 else set()
        for view, (before, after) in enumerate(zip(instant.photographs, mended.photographs, strict=True)):
            assert (after is before) == (view not in wrong)
            if view in wrong:
                assert (after.mask ^ right[view]).sum() < 0.4 * (before.mask ^ right[view]).sum()
    assert len(rounds) > COUNT
    # Each round uses hulls of the masks corrected so far.
    assert all(a is b for masks, hulls in rounds for a, b in zip(masks, hulls, strict=True))


def test_a_smaller_photograph_has_its_camera():
    photograph = capture(figure()).photographs[0]
    small = shrink(photograph, 3)
    assert small.image.shape == (85, 64, 3)
    means = photograph.image[:255].reshape(85, 3, 64, 3, 3).mean((1, 3))
    assert np.abs(small.image - means).max() < 1
    point = photograph.intrinsics @ [0.1, 0.2, 1.0]
    np.testing.assert_allclose(3 * (small.intrinsics @ [0.1, 0.2, 1.0])[:2], point[:2])
