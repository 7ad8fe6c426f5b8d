"""What training draws: samples that resume, are fair, and follow the seed."""

import numpy as np
import torch

from ghgs_lit.data.sampling import (
    TargetProtocol,
    TrainingSampler,
    ViewProtocol,
    evaluation_samples,
)

FULL = tuple(range(16))
RANDOM = ViewProtocol()
MIDWAY = {"name": "midway", "per_subject": "all"}


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
    """A resumed run sees what an uninterrupted one sees; no global generator matters."""
    forward = [sampler().batch(step) for step in range(40)]
    backward = [sampler().batch(step) for step in reversed(range(40))][::-1]
    assert forward == backward
    assert forward != [sampler(seed=1).batch(step) for step in range(40)]
    torch.manual_seed(5)
    np.random.seed(5)  # noqa: NPY002  no global generator has a say
    assert forward[7] == sampler().batch(7)


def test_batches_of_a_class_have_one_number_of_inputs():
    """Their subjects and cameras differ, and every number is drawn."""
    batches = [sampler(class_steps=8).batch(step) for step in range(160)]
    counts = [len(batch[0].inputs) for batch in batches]
    assert all(len(set(counts[first : first + 8])) == 1 for first in range(0, 160, 8))
    assert set(counts) == {3, 4, 5}
    assert len({batch[0].inputs for batch in batches[:8]}) == 8
    once = [len(sampler().batch(step)[0].inputs) for step in range(20)]
    assert counts[::8] == once


def test_training_samples_are_fair():
    """Every subject once in each round, all counts, positions and views,
    no target among the inputs."""
    batches = [sampler().batch(step) for step in range(300)]
    for batch in batches:
        assert len({len(d.inputs) for d in batch}) == 1
        for sample in batch:
            assert len(set(sample.inputs)) == len(sample.inputs)
            assert len(set(sample.targets)) == 3
            assert not set(sample.targets) & set(sample.inputs)
    names = [d.subject for batch in batches for d in batch]
    for start in range(0, 600, 5):  # every subject once in each round
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
    """Several processes train on the samples of one, each sample once."""
    whole = [d.subject for step in range(5) for d in sampler(batch_size=4).batch(step)]
    ranks = [[sampler().batch(step, rank, 2) for step in range(5)] for rank in range(2)]
    assert whole == [d.subject for step in range(5) for rank in range(2) for d in ranks[rank][step]]
    for one, other in zip(*ranks, strict=True):
        assert len(one[0].inputs) == len(other[0].inputs)


def test_even_training_views_keep_their_spacing():
    """views.training=even turns the ring but keeps the distances."""
    even = sampler(ViewProtocol(training_counts=(5,), training="even"))
    starts = set()
    for step in range(60):
        positions = [position for position, _ in even.batch(step)[0].inputs]
        starts.add(positions[0])
        assert sorted(np.diff([*positions, positions[0]]) % 16) == [3, 3, 3, 3, 4]
    assert len(starts) > 10


def test_seeds_choose_photographs_as_well_as_the_order_of_subjects():
    """Of a single subject, whose order is no choice;
    numbers of views and targets of evaluation, too."""
    one = {"subjects": {"a": FULL}, "batch_size": 1}

    def drawn(seed):
        return [sampler(seed=seed, **one).batch(step)[0] for step in range(20)]

    assert drawn(0) == drawn(0)
    pairs = list(zip(drawn(0), drawn(1), strict=True))
    assert sum(len(a.inputs) != len(b.inputs) for a, b in pairs) > 5
    fixed = ViewProtocol(training_counts=(4,))
    inputs = [{sampler(fixed, seed=s, **one).batch(t)[0].inputs for t in range(20)} for s in range(2)]
    assert not inputs[0] & inputs[1]
    names = [[d.subject for t in range(20) for d in sampler(seed=s).batch(t)] for s in range(2)]
    assert names[0] != names[1]
    targets = TargetProtocol(name="random", per_subject=3)
    measured = [evaluation_samples({"a": FULL, "b": FULL}, 4, [targets], 16, seed) for seed in (0, 0, 1)]
    assert measured[0] == measured[1]
    assert all(a.targets != b.targets for a, b in zip(measured[0], measured[2], strict=True))
