"""Sampling protocols and data modules: camera angles, batches, errors, and training samples that resume
exactly, are fair and depend on the seed."""

import shutil

import numpy as np
import pytest
import torch

from ghgs_lit.data.sampling import (
    TargetProtocol,
    TrainingSampler,
    ViewProtocol,
    evaluation_samples,
    even_positions,
    middle,
)
from ghgs_lit.errors import InputError
from tests.helpers.people import RELEASE, V4, equal, rendered

FULL = tuple(range(16))
RANDOM = ViewProtocol()
MIDWAY = {"name": "midway", "per_subject": "all"}


def module(boxes, **changes):
    return rendered(boxes, **{"batch_size": 2, **changes})


def turns(cameras) -> np.ndarray:
    """Yaw of cameras in degrees, from their extrinsics."""
    center = cameras.centers.double().numpy()
    return np.degrees(np.arctan2(center[..., 0], center[..., 2]))


def between(a, b) -> np.ndarray:
    return np.abs((a - b + 180) % 360 - 180)


@pytest.mark.parametrize(("count", "positions"), [(3, [0, 5, 10]), (4, [0, 4, 8, 12]), (5, [0, 3, 6, 9, 12])])
def test_even_positions_are_the_protocols(count, positions):
    """Even positions equal those of the published protocols for 3, 4 and 5 views."""
    assert even_positions(16, count) == positions


@pytest.mark.parametrize("count", [3, 4, 5])
def test_uneven_views_stay_around_the_subject(count):
    """Positions are distinct, and each is at most one position from even spacing."""
    protocol = ViewProtocol(training_counts=(count,), training="uneven")
    draws = [protocol.sample(FULL, count, 16, np.random.default_rng(seed)) for seed in range(80)]
    gaps = {tuple(np.diff([*positions, positions[0]]) % 16) for positions in draws}
    assert all(len(set(positions)) == count for positions in draws)
    assert all(max(g) <= 16 // count + 3 for g in gaps)
    assert len(gaps) > 15


def test_uneven_views_need_room():
    """Even positions less than 3 apart could coincide."""
    protocol = ViewProtocol(training_counts=(4,), training="uneven")
    with pytest.raises(InputError, match=r"views\.training: expected any or even for 4 views of 8 positions"):
        TrainingSampler({"a": tuple(range(8))}, protocol, TargetProtocol(name="release"), 8, 1, 0)


@pytest.mark.parametrize("count", [3, 4, 5])
def test_targets_stand_where_their_protocol_says(boxes, count):
    """Targets of release are 11.25 degrees from the first input, and those of midway equally far from two
    inputs, measured from the cameras."""
    data = module(boxes)
    for batch in data.evaluation_loader(count, TargetProtocol(name="release")):
        first, target = turns(batch.cameras)[:, 0], turns(batch.targets.cameras)[:, 0]
        np.testing.assert_allclose((target - first) % 360, 11.25, atol=1e-3)
        assert batch.targets.names == (("000/3",),) * len(batch.subjects)
    for batch in data.evaluation_loader(count, MIDWAY):
        inputs, targets = turns(batch.cameras), turns(batch.targets.cameras)
        assert targets.shape[1] == count
        step = 22.5 * np.diff([*even_positions(16, count), 16])
        np.testing.assert_allclose(
            between(targets, inputs), np.broadcast_to(step / 2, targets.shape), atol=1e-3
        )
        after = np.roll(inputs, -1, axis=1)
        np.testing.assert_allclose(
            between(targets, after), np.broadcast_to(step / 2, targets.shape), atol=1e-3
        )
    if count == 4:
        batch = next(iter(data.evaluation_loader(4, {"name": "midway"})))
        assert batch.targets.names[0] == ("002/0",)
        np.testing.assert_allclose(
            between(turns(batch.targets.cameras), turns(batch.cameras)[:, :1]), 45, atol=1e-3
        )


@pytest.mark.parametrize(
    ("first", "second", "photo"),
    [(0, 5, (2, 3)), (12, 0, (14, 0)), (10, 0, (13, 0)), (15, 0, (15, 3)), (15, 2, (0, 3))],
)
def test_middle_wraps_around_the_ring(first, second, photo):
    """The middle is correct also across the end of the ring."""
    assert middle(first, second, 16) == photo


def test_release_beside_every_input_and_listed_positions():
    """per_subject=all gives a target next to every input, and listed inputs replace the even ones."""
    targets = TargetProtocol(name="release", per_subject="all")
    samples = evaluation_samples({"a": FULL}, 3, [targets], 16, 0, [[0, 6, 11]])
    assert samples[0].inputs == ((0, 0), (6, 0), (11, 0))
    assert samples[0].targets == ((0, 3), (6, 3), (11, 3))


def test_random_targets_of_evaluation_are_fixed_and_differ_between_subjects():
    """Random targets are equal at each evaluation, and differ between subjects."""
    targets = TargetProtocol(name="random", per_subject=3)
    subjects = {f"s{i}": FULL for i in range(6)}
    first = evaluation_samples(subjects, 4, [targets], 16, 0)
    assert first == evaluation_samples(subjects, 4, [targets], 16, 0)
    assert len({d.targets for d in first}) == 6
    for sample in first:
        assert len(set(sample.targets)) == 3
        assert not set(sample.targets) & set(sample.inputs)


def test_batches_have_the_shapes_and_values_they_promise(boxes):
    """Batches have the documented shapes, dtypes and ranges, and all vertices of a body."""
    data = module(boxes, targets={"name": "random", "per_step": 2}, target_size=[42, 35])
    batch = data.training_batch(0)
    assert batch.images.shape == (2, 4, 3, 28, 28)
    assert batch.targets.images.shape == (2, 2, 3, 42, 35)
    assert (batch.targets.cameras.height, batch.targets.cameras.width) == (42, 35)
    assert batch.masks.dtype == torch.bool
    assert batch.images.dtype == batch.depths.dtype == batch.cameras.extrinsics.dtype == torch.float32
    assert 0.3 < batch.images.max() <= 1
    assert [tuple(b.shape) for b in batch.body_vertices] == [(8, 3)] * 2
    assert ((batch.depths > 1.5) & (batch.depths < 2.5))[batch.masks].float().mean() > 0.98
    assert torch.equal(batch.depths > 0, batch.alpha > 0)
    assert torch.equal(batch.masks, batch.alpha > 0.5)
    assert ((batch.alpha > 0) & (batch.alpha < 1)).any()
    # Premultiplied, with a tolerance for JPEG.
    assert (batch.images.amax(2) <= batch.alpha + 4 / 255).all()
    assert [len(v) for v in batch.views] == [4, 4]
    # Antialiased rims are kept: some pixels outside the mask are not black.
    outside = batch.images.movedim(2, -1)[~batch.masks]
    assert outside.max() > 0.05
    assert torch.equal(data.training_batch(0).body_vertices[0], batch.body_vertices[0])


def test_data_without_depth_or_body_says_none(boxes, tmp_path):
    """Missing depths, bodies or mattes, even of a single image, become None, not zeros."""
    shutil.copytree(boxes / "train", tmp_path / "train")
    shutil.rmtree(tmp_path / "train" / "depth")
    shutil.rmtree(tmp_path / "train" / "smpl" / "s1")
    for folder in (tmp_path / "train" / "alpha").glob("s1_*"):
        shutil.rmtree(folder)
    batch = module(tmp_path, batch_size=3).training_batch(0)
    assert batch.depths is None
    assert batch.alpha is None
    assert batch.body_vertices is None


def test_an_epoch_and_the_evaluation_have_the_expected_length(boxes):
    """Lengths depend on subjects, batch size and steps_per_epoch; evaluation repeats exactly."""
    data = module(boxes)
    assert len(data.train_dataloader()) == 100  # 50 passes over 3 subjects, 2 at a time
    assert [len(batch.subjects) for batch in data.val_dataloader()] == [2]
    assert [len(b.subjects) for b in data.evaluation_loader(split="train", batch_size=2)] == [2, 1]
    assert len(module(boxes, steps_per_epoch=7).train_dataloader()) == 7
    again = [b for _ in range(2) for b in module(boxes).val_dataloader()]
    assert equal(*again)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"batch_size": 0}, "data.batch_size: expected an integer >= 1 and <= 1024; found 0"),
        (
            {"views": V4 | {"training_counts": [1]}},
            r"views.training_counts: expected a list \(each an integer >= 2\)",
        ),
        (
            {"views": V4 | {"training": "odd"}},
            "views.training: expected one of any, even, uneven",
        ),
        ({"views": V4 | {"trainign": "any"}}, "views.trainign: expected one of .*; found 'trainign'"),
        ({"targets": {"name": "sideways"}}, "targets.kind: expected one of release, midway, random"),
        (
            {"targets": RELEASE | {"training_views": [7]}},
            r"targets.training_views: expected a list \(each one of 0, 1, 2, 3, 4\)",
        ),
        (
            {"targets": RELEASE | {"per_subject": 0}},
            "targets.per_subject: expected an integer >= 1 or all; found 0",
        ),
        ({"size": [3, 4, 5]}, "data.size: expected an integer >= 1 and <= 8192 or a list of 2 values"),
        ({"pixel_centers": "corner"}, "data.pixel_centers: expected one of half, integer"),
        ({"workers": -1}, "data.workers: expected an integer >= 0"),
    ],
)
def test_impossible_values_fail_at_once(boxes, changes, message):
    """A wrong value or key is rejected with its name when the configuration is read."""
    with pytest.raises(InputError, match=message):
        module(boxes, **changes)


def test_fewer_views_than_asked(boxes, tmp_path):
    """Too few cameras raise with the subject's name, unless other positions are listed."""
    for kind in ("img", "mask", "parm", "depth"):
        for position in (0, 4, 9):
            for phase, name in (("train", "s0"), ("val", "s3")):
                shutil.copytree(
                    boxes / phase / kind / f"{name}_{position:03d}",
                    tmp_path / phase / kind / f"{name}_{position:03d}",
                )
    data = module(tmp_path, batch_size=1)
    with pytest.raises(
        InputError, match="expected 4 ring positions of subject s0 to draw 4 views from; found 3"
    ):
        data.train_dataloader()
    with pytest.raises(
        InputError, match=r"expected ring positions \[0, 4, 8, 12\] of subject s3; found no position 8"
    ):
        data.val_dataloader()
    with pytest.raises(
        InputError, match=r"targets.per_subject: expected at most the 4 inputs, or all; found 5"
    ):
        module(boxes).evaluation_loader(4, {"name": "midway", "per_subject": 5})
    listed = module(tmp_path, evaluation_positions=[[0, 4, 9]], batch_size=1)
    assert next(iter(listed.evaluation_loader(3))).views == (("000/0", "004/0", "009/0"),)


def test_a_subject_alone_is_read_without_targets(boxes):
    """A splat needs no target, so that a subject whose cameras are all inputs can be read."""
    data = module(
        boxes, targets={"name": "cameras", "view": 0, "training_views": [0], "positions": [0, 4, 8, 12]}
    )
    with pytest.raises(InputError, match=r"targets\.positions: expected a camera that is not an input"):
        data.evaluation_loader()
    batch = data.evaluation_batch("s4")
    assert batch.targets is None
    assert batch.subjects == ("s4",)
    assert batch.views == (("000/0", "004/0", "008/0", "012/0"),)
    beside = data.evaluation_batch("s4", targets=RELEASE)
    assert torch.equal(beside.images, batch.images)
    assert beside.targets.names == (("000/3",),)


@pytest.mark.parametrize("count", [0, 17])
def test_a_number_of_views_that_a_ring_does_not_have_is_refused(boxes, count):
    """0 views must not count as 4, nor may 17 of 16 repeat a position."""
    with pytest.raises(InputError, match=f"evaluation with {count} views: expected different positions"):
        module(boxes).evaluation_loader(views=count)


def test_the_seed_of_the_data_reaches_training_and_random_targets(boxes):
    """Equal seeds give equal batches, different seeds different ones."""
    random = {"name": "random", "per_subject": 3}
    for draw in (
        lambda seed: [
            (b.subjects, b.views, b.targets.names)
            for b in map(module(boxes, seed=seed).training_batch, range(4))
        ],
        lambda seed: [b.targets.names for b in module(boxes, seed=seed).evaluation_loader(4, random)],
    ):
        assert draw(0) == draw(0) != draw(1)


def sampler(views=RANDOM, targets=None, **changes) -> TrainingSampler:
    targets = targets or TargetProtocol(name="random", per_step=3)
    arguments = {
        "subjects": {f"s{i}": FULL for i in range(5)},
        "ring": 16,
        "batch_size": 2,
        "seed": 0,
    } | changes
    return TrainingSampler(views=views, targets=targets, **arguments)


def test_training_samples_depend_on_seed_step_and_index_only():
    """Samples are the same in any order of steps, and do not depend on global generators."""
    forward = [sampler().batch(step) for step in range(40)]
    backward = [sampler().batch(step) for step in reversed(range(40))][::-1]
    assert forward == backward
    assert forward != [sampler(seed=1).batch(step) for step in range(40)]
    torch.manual_seed(5)
    np.random.seed(5)  # noqa: NPY002  global generators must not matter
    assert forward[7] == sampler().batch(7)


def test_training_samples_are_fair():
    """Each epoch has every subject once; all counts, positions and views occur, and no target is an input."""
    batches = [sampler().batch(step) for step in range(300)]
    for batch in batches:
        assert len({len(d.inputs) for d in batch}) == 1
        for sample in batch:
            assert len(set(sample.inputs)) == len(sample.inputs)
            assert len(set(sample.targets)) == 3
            assert not set(sample.targets) & set(sample.inputs)
    names = [d.subject for batch in batches for d in batch]
    for start in range(0, 600, 5):  # every subject once per epoch
        assert sorted(names[start : start + 5]) == ["s0", "s1", "s2", "s3", "s4"]
    assert len({tuple(names[s : s + 5]) for s in range(0, 600, 5)}) > 30
    counts = np.bincount([len(batch[0].inputs) for batch in batches], minlength=6)[3:]
    assert counts.min() > 70
    seen = np.bincount(
        [position for batch in batches for d in batch for position, _ in d.inputs], minlength=16
    )
    assert seen.min() > 0.6 * seen.mean()
    assert {view for batch in batches for d in batch for _, view in d.targets} == {0, 2, 3, 4}


def test_processes_share_out_one_sequence():
    """Several processes train on the samples of a single one, each sample once."""
    whole = [d.subject for step in range(5) for d in sampler(batch_size=4).batch(step)]
    ranks = [[sampler().batch(step, rank, 2) for step in range(5)] for rank in range(2)]
    assert whole == [d.subject for step in range(5) for rank in range(2) for d in ranks[rank][step]]
    for one, other in zip(*ranks, strict=True):
        assert len(one[0].inputs) == len(other[0].inputs)


def test_even_training_views_keep_their_spacing():
    """views.training=even rotates the positions but keeps their spacing."""
    even = sampler(ViewProtocol(training_counts=(5,), training="even"))
    starts = set()
    for step in range(60):
        positions = [position for position, _ in even.batch(step)[0].inputs]
        starts.add(positions[0])
        assert sorted(np.diff([*positions, positions[0]]) % 16) == [3, 3, 3, 3, 4]
    assert len(starts) > 10


def test_seeds_choose_photographs_as_well_as_the_order_of_subjects():
    """With a single subject, the seed still determines views and their number."""
    one = {"subjects": {"a": FULL}, "batch_size": 1}

    def drawn(seed):
        return [sampler(seed=seed, **one).batch(step)[0] for step in range(20)]

    pairs = list(zip(drawn(0), drawn(1), strict=True))
    assert sum(len(a.inputs) != len(b.inputs) for a, b in pairs) > 5
    fixed = ViewProtocol(training_counts=(4,))
    inputs = [{sampler(fixed, seed=s, **one).batch(t)[0].inputs for t in range(20)} for s in range(2)]
    assert not inputs[0] & inputs[1]
    names = [[d.subject for t in range(20) for d in sampler(seed=s).batch(t)] for s in range(2)]
    assert names[0] != names[1]
