"""Augmentation of training batches: effects of each option, and dependence on seed and step only."""

import numpy as np
import pytest
import torch

from ghgs_lit.config import compose
from ghgs_lit.config.registry import read_node
from ghgs_lit.data.augmentation import Augmentation
from ghgs_lit.data.imperfections import cut_subjects
from ghgs_lit.errors import InputError
from ghgs_lit.geometry.masks import surface_colors
from ghgs_lit.types import Batch
from tests.helpers.people import RELEASE, V4, equal, rendered

RANDOM = V4 | {"training_counts": [3, 4, 5], "training": "uneven"}
IMPERFECT = {
    "exposure": 0.5, "white_balance": 0.2, "gamma": 0.3, "mask_offset": 1.5, "mask_ragged": 1.0,
    "mask_hole_chance": 0.5, "calibration": 2.0,
}  # fmt: skip
EVERYTHING = IMPERFECT | {"sizes": [28, [42, 28]], "target_scale": [0.7, 2.0]}


def module(boxes, **changes):
    arguments = {"views": RANDOM, "targets": RELEASE, "size": 28, "batch_size": 2, "steps_per_epoch": 6}
    return rendered(boxes, **(arguments | changes))


def test_nothing_varies_by_default(boxes):
    """augmentation=none and no augmentation leave images as read, bit for bit."""
    none = compose("train").augmentation
    assert Augmentation.read(none, "augmentation") == Augmentation()
    data = module(boxes, augmentation=none)
    # Depths of targets are only for measurements.
    for step in range(3):
        batch = data.photographs("train").batch(data.training_sampler().batch(step), target_depths=False)
        assert equal(data.training_batch(step), batch)
        assert equal(module(boxes).training_batch(step), batch)


def test_batches_depend_on_seed_and_step_alone(boxes):
    """Batches depend neither on workers nor on what was read before, and differ between steps and seeds."""
    batches = list(module(boxes, augmentation=EVERYTHING, seed=2, workers=2).train_dataloader())
    assert len(batches) == 6
    data = module(boxes, augmentation=EVERYTHING, seed=2)
    for step in (5, 0, 3, 1, 4, 2, 5):
        assert equal(data.training_batch(step), batches[step])
    assert len({(batch.images.shape, round(batch.images.sum().item(), 3)) for batch in batches}) == 6
    others = [module(boxes, augmentation=EVERYTHING, seed=1).training_batch(step) for step in range(6)]
    assert not any(map(equal, batches, others))


def test_imperfections_and_sizes_differ_between_seeds_steps_and_samples(boxes):
    """The same images get other imperfections in another step, run or place of the batch."""
    clean, varied = module(boxes).training_batch(0), Augmentation(**EVERYTHING)

    def drawn(seed, step, indices=(6, 7)):
        return varied.augment(clean, seed, step, indices)

    first = drawn(0, 3)
    assert equal(first, drawn(0, 3))
    for other in (drawn(1, 3), drawn(0, 6), drawn(0, 3, (8, 9))):
        for name in ("intrinsics", "extrinsics"):
            one, two = (getattr(batch.cameras, name) for batch in (first, other))
            assert (one != two).flatten(1).any(1).all()
        assert (first.images != other.images).flatten(1).any(1).all()
    sizes = [
        [varied.sample_sizes((28, 28), (56, 56), seed, step) for step in range(12)] for seed in (0, 0, 1)
    ]
    assert sizes[0] == sizes[1] != sizes[2]
    sometimes = Augmentation(**IMPERFECT, chance=0.5)
    changed = [
        [not equal(sometimes.augment(clean, seed, step, (0, 1)), clean) for step in range(20)]
        for seed in (0, 0, 1)
    ]
    assert changed[0] == changed[1] != changed[2]


def test_sizes_are_drawn_for_a_step_and_cameras_follow(boxes):
    """Every size occurs, equal in all processes, and targets are 0.7 to 2 times as large."""
    data = module(
        boxes, target_size=[84, 84], augmentation={"sizes": [28, [42, 28]], "target_scale": [0.7, 2.0]}
    )
    inputs, scales = set(), []
    for step in range(12):
        batch = data.training_batch(step)
        size = tuple(batch.images.shape[-2:])
        inputs.add(size)
        ratios = np.array(batch.targets.images.shape[-2:]) / size
        assert abs(ratios[0] - ratios[1]) < 1 / 28
        scales.append(ratios[0])
        assert (batch.cameras.height, batch.cameras.width) == size
        whole = data.photographs("train").batch(data.training_sampler().batch(step))
        expected = whole.cameras.resize(*size).intrinsics
        torch.testing.assert_close(batch.cameras.intrinsics, expected)
        processes = [data.training_batches(1, rank, 2)[step] for rank in (0, 1)]
        assert len({one.images.shape[-3:] for one in processes}) == 1
        assert len({one.targets.images.shape for one in processes}) == 1
    assert inputs == {(28, 28), (42, 28)}
    assert min(scales) >= 0.69
    assert max(scales) <= 2.01
    assert np.ptp(scales) > 0.6


def test_drawn_sizes_keep_the_proportion_of_the_targets(boxes):
    """With data.target_size twice data.size, targets are twice as large as the sampled input size."""
    batch = module(boxes, target_size=56, augmentation={"sizes": [42]}).training_batch(0)
    assert batch.images.shape[-2:] == (42, 42)
    assert batch.targets.images.shape[-2:] == (84, 84)


def test_targets_are_never_enlarged(boxes):
    """Targets never exceed data.target_size, although the sampled scale would be twice the inputs' size."""
    data = module(boxes, target_size=42, augmentation={"target_scale": [1.0, 2.0]})
    sides = {data.training_batch(step).targets.images.shape[-1] for step in range(12)}
    assert 28 <= min(sides) < 36
    assert max(sides) == 42


def test_a_share_of_the_steps_is_imperfect(boxes):
    """All other steps are as read, bit for bit; chance=1 means every step."""
    clean, some, every = (module(boxes, augmentation=a) for a in ({}, IMPERFECT | {"chance": 0.4}, IMPERFECT))
    steps = [(clean.training_batch(step), some.training_batch(step)) for step in range(40)]
    changed = [step for step, pair in enumerate(steps) if not equal(*pair)]
    assert 8 <= len(changed) <= 24
    assert equal(steps[changed[0]][1], every.training_batch(changed[0]))


def test_the_last_part_of_a_run_is_exact(boxes):
    """From ``exact_from`` on, batches are as read; earlier ones are as without the option, bit for bit."""
    clean, always, first = (
        module(boxes, augmentation=a) for a in ({}, IMPERFECT, IMPERFECT | {"exact_from": 2})
    )
    for step in range(4):
        assert equal(first.training_batch(step), (always if step < 2 else clean).training_batch(step))


def find_differences(a, b) -> set[str]:
    """Names of the fields in which two batches differ."""
    cameras = {
        f"cameras.{name}": (getattr(a.cameras, name), getattr(b.cameras, name))
        for name in ("intrinsics", "extrinsics")
    }
    names = ("images", "masks", "depths", "alpha")
    tensors = {name: (getattr(a, name), getattr(b, name)) for name in names} | cameras
    found = {name for name, (x, y) in tensors.items() if not torch.equal(x, y)}
    return found | ({"targets"} if not equal(a.targets, b.targets) else set())


@pytest.mark.parametrize(
    ("names", "changed"),
    [
        (("exposure",), {"images"}),
        (("white_balance",), {"images"}),
        (("gamma",), {"images"}),
        (("mask_offset",), {"images", "masks", "alpha"}),
        (("mask_ragged",), {"images", "masks", "alpha"}),
        (("mask_hole_chance",), {"images", "masks", "alpha"}),
        (("calibration",), {"cameras.intrinsics", "cameras.extrinsics"}),
    ],
)
def test_each_imperfection_changes_its_part_of_the_inputs_alone(boxes, names, changed):
    """Targets, depths and other inputs stay unchanged, and each imperfection acts alone as in combination."""
    chosen = {name: IMPERFECT[name] for name in names}
    clean, batch = (module(boxes, augmentation=a).training_batch(1) for a in ({}, chosen))
    assert find_differences(clean, batch) == changed
    together = module(boxes, augmentation=IMPERFECT).training_batch(1)
    everything = {"images", "masks", "alpha", "cameras.intrinsics", "cameras.extrinsics"}
    assert find_differences(clean, together) == everything
    # The matte follows the mask: 0 outside it, and 1 where the mask was enlarged.
    assert not together.alpha[~together.masks].any()
    assert (together.alpha[together.masks & ~clean.masks] == 1).all()
    kept = together.masks & clean.masks
    assert torch.equal(together.alpha[kept], clean.alpha[kept])
    if names == ("calibration",):
        assert "cameras.extrinsics" not in find_differences(batch, together)
    for one in (batch, together):
        assert one.images.min() >= 0
        assert one.images.max() <= 1
        assert one.masks.flatten(2).any(-1).all()


def test_a_wrong_mask_shows_the_background(boxes):
    """Pixels that a mask adds show the background; where the mask is right nothing changes."""
    outlines = {"mask_offset": 1.5, "mask_ragged": 1.0}
    clean, black, cloudy = (
        module(boxes, augmentation=a).training_batch(1)
        for a in ({}, outlines, outlines | {"background": 1.0})
    )
    assert torch.equal(black.masks, cloudy.masks)
    added = cloudy.masks & (clean.alpha == 0)
    assert added.any()
    assert ((cloudy.images - black.images).amax(2)[added] > 0.05).float().mean() > 0.9
    sure = cloudy.masks & (clean.alpha == 1)
    assert torch.equal(cloudy.images.movedim(2, -1)[sure], clean.images.movedim(2, -1)[sure])
    assert not cloudy.images.movedim(2, -1)[~cloudy.masks].any()
    assert torch.equal(cloudy.alpha, cloudy.masks.float())


def test_refined_masks_are_those_of_a_capture(boxes):
    """refined=1 estimates mattes from the images, for outlines that are off by the configured pixels."""
    wrong = {"mask_offset": 1.5, "mask_ragged": 1.0, "background": 1.0}
    clean, given, found = (
        module(boxes, augmentation=a).training_batch(1) for a in ({}, wrong, wrong | {"refined": 1.0})
    )
    errors = [(batch.alpha - clean.alpha).abs().mean() for batch in (given, found)]
    assert errors[1] < errors[0]
    assert torch.equal(found.masks, found.alpha > 0.5)
    assert ((found.alpha > 0) & (found.alpha < 1)).any()
    assert found.images.max() <= 1
    assert (found.images <= found.alpha[:, :, None] + 1 / 255).all()
    assert equal(found.targets, clean.targets)


def test_tone_curves_raise_the_surface_to_a_power(boxes):
    """Each camera has one power, powers differ with a geometric mean of 1, and black and mattes stay."""
    clean, toned = (module(boxes, augmentation=a).training_batch(1) for a in ({}, {"gamma": 0.3}))
    one, other = (surface_colors(batch).double() for batch in (clean, toned))
    sure = ((clean.alpha > 0.5)[:, :, None] & (one > 0.1) & (one < 0.9)).expand_as(one)
    powers = torch.where(sure, other.log() / one.log(), torch.nan).flatten(2)
    for b, v in np.ndindex(*powers.shape[:2]):
        values = powers[b, v][~powers[b, v].isnan()]
        torch.testing.assert_close(values, values.median().expand_as(values), rtol=1e-3, atol=1e-3)
    logs = powers.nanmedian(-1).values.log()
    assert logs.abs().max() < 0.301
    assert (logs.amax(1) - logs.amin(1) > 0.05).all()
    torch.testing.assert_close(logs.mean(1), torch.zeros(len(logs)).double(), rtol=0, atol=1e-3)


def test_a_cut_moves_photographs_and_cameras_together(boxes):
    """World points keep their colours until they leave the frame, and subjects that are not cut everywhere
    stay whole in some view."""
    clean = module(boxes).training_batch(1)
    kinds = set()
    for seed in range(12):
        rngs = [np.random.default_rng([seed, b]) for b in range(2)]
        batch = cut_subjects(clean, 1.0, rngs)
        rows = batch.cameras.intrinsics[..., 1, 2] - clean.cameras.intrinsics[..., 1, 2]
        lower = batch.targets.cameras.intrinsics[..., 1, 2] - clean.targets.cameras.intrinsics[..., 1, 2]
        for name in ("images", "masks", "depths", "alpha"):
            before, after = getattr(clean, name), getattr(batch, name)
            for b, v in np.ndindex(*rows.shape):
                down = int(rows[b, v])
                assert torch.equal(
                    after[b, v][..., down:, :], before[b, v][..., : before.shape[-2] - down, :]
                )
                assert not after[b, v][..., :down, :].any()
        left = batch.masks.sum((2, 3)) / clean.masks.sum((2, 3))
        assert (left > 0.2).all()
        for b in range(2):
            everywhere = bool((lower[b] > 0).any())
            kinds.add(everywhere)
            assert bool((rows[b] > 0).all()) == everywhere
            assert bool((lower[b] > 0).all()) == everywhere
            assert (rows[b] > 0).any()
            assert everywhere or (left[b] == 1).any()
    assert kinds == {True, False}
    assert equal(cut_subjects(clean, 0.0, [np.random.default_rng(b) for b in range(2)]), clean)


def test_imperfections_do_not_depend_on_batch_mates(boxes):
    """Two elements in a batch get the same imperfections as each alone."""
    batch = module(boxes).training_batch(0)
    augmentation = Augmentation(**IMPERFECT)

    def perturb(one, seeds):
        return augmentation.add_imperfections(one, [np.random.default_rng(seed) for seed in seeds])

    def element(one, b):
        return Batch(one.images[[b]], one.masks[[b]], one.cameras[[b]], alpha=one.alpha[[b]])

    both = perturb(batch, (3, 4))
    for b, seed in enumerate((3, 4)):
        alone = perturb(element(batch, b), (seed,))
        assert torch.equal(alone.images[0], both.images[b])
        assert torch.equal(alone.masks[0], both.masks[b])
        assert torch.equal(alone.cameras.extrinsics[0], both.cameras.extrinsics[b])


def test_validation_does_not_vary(boxes):
    """All runs are validated on the same images."""
    clean, varied = (module(boxes, views=V4, augmentation=a) for a in ({}, EVERYTHING))
    pairs = list(zip(clean.val_dataloader(), varied.val_dataloader(), strict=True))
    assert [batch.subjects for batch, _ in pairs] == [("s3", "s4")]
    assert all(equal(*pair) for pair in pairs)
    everyone = [list(data.evaluation_loader(split="train")) for data in (clean, varied)]
    assert sum(len(batch.subjects) for batch in everyone[0]) == 3
    assert all(map(equal, *everyone))


def test_shipped_variation_is_built():
    """The shipped option composes, and its sizes are divisible by the encoder's patch size."""
    augmentation = read_node(compose("train", ["augmentation=captures"]).augmentation, "augmentation")
    assert all(side % 14 == 0 for size in augmentation.sizes for side in size)
    assert all(getattr(augmentation, name) > 0 for name in IMPERFECT)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"sizes": []}, "augmentation.sizes: expected sizes or null; found"),
        ({"sizes": [[3, 4, 5]]}, r"augmentation.sizes: expected a list \(each an integer"),
        ({"target_scale": [2, 1]}, r"augmentation.target_scale: expected \[least, greatest\] above 0"),
        ({"chance": 1.5}, "augmentation.chance: expected a number >= 0 and <= 1; found 1.5"),
        ({"background": 2}, "augmentation.background: expected a number >= 0 and <= 1; found 2"),
        ({"gamma": 1e9}, "augmentation.gamma: expected a number >= 0 and <= 1; found"),
        ({"cut": 2}, "augmentation.cut: expected a number >= 0 and <= 1; found 2"),
        ({"calibration": -1}, "augmentation.calibration: expected a number >= 0; found -1"),
        ({"mask_holes": 1}, "augmentation.mask_holes: .*did you mean mask_hole_chance"),
    ],
)
def test_impossible_values_are_refused(boxes, values, message):
    """The error names the key."""
    with pytest.raises(InputError, match=message):
        module(boxes, augmentation=values)
