"""Sampling protocols and the DataModules: angles, batches, refusals."""

import numpy as np
import pytest
import torch
from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import ModelCheckpoint

from ghgs_lit.data.sampling import (
    TargetProtocol,
    TrainingSampler,
    ViewProtocol,
    evaluation_samples,
    even_positions,
    middle,
)
from ghgs_lit.errors import InputError
from tests.helpers.people import RELEASE, V4, equal, render_boxes, rendered

FULL = tuple(range(16))
RANDOM = ViewProtocol()
MIDWAY = {"name": "midway", "per_subject": "all"}


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    folder = tmp_path_factory.mktemp("rendered")
    render_boxes(folder / "out", folder / "scans")
    return folder / "out"


def module(root, **changes):
    return rendered(root, **{"batch_size": 2, **changes})


def turns(cameras) -> np.ndarray:
    """Yaw of cameras in degrees from their actual extrinsics."""
    center = cameras.centers.double().numpy()
    return np.degrees(np.arctan2(center[..., 0], center[..., 2]))


def between(a, b) -> np.ndarray:
    return np.abs((a - b + 180) % 360 - 180)


def test_even_positions_are_the_protocols():
    """The inputs of the published protocols for 3, 4 and 5 views."""
    assert even_positions(16, 3) == [0, 5, 10]
    assert even_positions(16, 4) == [0, 4, 8, 12]
    assert even_positions(16, 5) == [0, 3, 6, 9, 12]


@pytest.mark.parametrize("count", [3, 4, 5])
def test_uneven_views_stay_around_the_subject(count):
    """Neighbours are a position or more apart;
    no camera is further than one from where it is even."""
    protocol = ViewProtocol(training_counts=(count,), training="uneven")
    draws = [protocol.draw(FULL, count, 16, np.random.default_rng(seed)) for seed in range(80)]
    gaps = {tuple(np.diff([*positions, positions[0]]) % 16) for positions in draws}
    assert all(len(set(positions)) == count for positions in draws)
    assert all(max(g) <= 16 // count + 3 for g in gaps)
    assert len(gaps) > 15


def test_uneven_views_need_room():
    """Positions that are closer than 3 could meet."""
    protocol = ViewProtocol(training_counts=(4,), training="uneven")
    with pytest.raises(InputError, match=r"views\.training: expected any or even for 4 views of 8 positions"):
        TrainingSampler({"a": tuple(range(8))}, protocol, TargetProtocol(name="release"), 8, 1, 0)


@pytest.mark.parametrize("count", [3, 4, 5])
def test_targets_stand_where_their_protocol_says(root, count):
    """Angles of the actual cameras: 11.25 degrees beside the first input;
    equally far from two inputs."""
    data = module(root)
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


def test_middle_wraps_around_the_ring():
    """The middle of two positions is right across the end of the ring."""
    assert middle(0, 5, 16) == (2, 3)
    assert middle(12, 0, 16) == (14, 0)
    assert middle(10, 0, 16) == (13, 0)
    assert middle(15, 0, 16) == (15, 3)
    assert middle(15, 2, 16) == (0, 3)


def test_release_beside_every_input_and_listed_positions():
    """per_subject=all measures beside every input; listed inputs replace the even ones."""
    targets = TargetProtocol(name="release", per_subject="all")
    samples = evaluation_samples({"a": FULL}, 3, [targets], 16, 0, [[0, 6, 11]])
    assert samples[0].inputs == ((0, 0), (6, 0), (11, 0))
    assert samples[0].targets == ((0, 3), (6, 3), (11, 3))


def test_random_targets_of_evaluation_are_fixed_and_differ_between_subjects():
    """Evaluation measures the same targets every time."""
    targets = TargetProtocol(name="random", per_subject=3)
    subjects = {f"s{i}": FULL for i in range(6)}
    first = evaluation_samples(subjects, 4, [targets], 16, 0)
    assert first == evaluation_samples(subjects, 4, [targets], 16, 0)
    assert len({d.targets for d in first}) == 6
    for sample in first:
        assert len(set(sample.targets)) == 3
        assert not set(sample.targets) & set(sample.inputs)


def test_batches_have_the_shapes_and_values_they_promise(root):
    """Shapes, types and value ranges of a batch; every vertex of a body counts."""
    data = module(root, targets={"name": "random", "per_step": 2}, target_size=[42, 35])
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
    # premultiplied; JPEG may add a little
    assert (batch.images.amax(2) <= batch.alpha + 4 / 255).all()
    assert [len(v) for v in batch.views] == [4, 4]
    # Antialiased rims stay: some light outside the mask.
    outside = batch.images.movedim(2, -1)[~batch.masks]
    assert outside.max() > 0.05
    assert torch.equal(data.training_batch(0).body_vertices[0], batch.body_vertices[0])


def test_data_without_depth_or_body_says_none(root, tmp_path):
    """Missing depths, bodies or mattes (of one photograph) become None, not zeros."""
    import shutil

    shutil.copytree(root / "train", tmp_path / "train")
    shutil.rmtree(tmp_path / "train" / "depth")
    shutil.rmtree(tmp_path / "train" / "smpl" / "s1")
    for folder in (tmp_path / "train" / "alpha").glob("s1_*"):
        shutil.rmtree(folder)
    batch = module(tmp_path, batch_size=3).training_batch(0)
    assert batch.depths is None
    assert batch.alpha is None
    assert batch.body_vertices is None


def test_training_reads_depths_where_a_loss_does(root):
    """Decoding depth maps that nothing reads is wasted;
    the depth error needs them in validation."""
    data = module(root)
    assert next(iter(data.train_dataloader())).depths is not None
    data.trains_on_depths = False
    assert next(iter(data.train_dataloader())).depths is None
    assert next(iter(data.val_dataloader())).depths is not None


class Recorder(LightningModule):
    """Trains one number and notes what it saw."""

    def __init__(self) -> None:
        super().__init__()
        self.weight = torch.nn.Parameter(torch.zeros(()))
        self.seen = []

    def training_step(self, batch, _):
        self.seen.append((batch.subjects, batch.views, batch.targets.names))
        return (self.weight * batch.images.mean()) ** 2

    def configure_optimizers(self):
        return torch.optim.SGD(self.parameters(), 0.1)


def train(root, steps, checkpoint=None, folder=None, workers=0):
    recorder = Recorder()
    saver = ModelCheckpoint(folder, every_n_train_steps=3, save_top_k=-1, filename="{step}")
    trainer = Trainer(
        max_steps=steps,
        accelerator="cpu",
        logger=False,
        callbacks=[saver],
        enable_progress_bar=False,
        enable_model_summary=False,
        num_sanity_val_steps=0,
        limit_val_batches=0,
    )
    data = module(root, views=RANDOM, steps_per_epoch=4, workers=workers)
    trainer.fit(recorder, datamodule=data, ckpt_path=checkpoint)
    return recorder.seen


@pytest.mark.filterwarnings("ignore")
def test_training_resumes_with_the_very_next_draw(root, tmp_path):
    """Stopped after 3 steps of an epoch of 4: the fourth is next, not the first again."""
    whole = train(root, 10, folder=tmp_path / "a")
    assert len(set(map(str, whole))) == 10
    for done in (3, 9):
        rest = train(root, 10, tmp_path / "a" / f"step={done}.ckpt", tmp_path / "b")
        assert rest == whole[done:]


def test_loading_processes_change_nothing(root):
    """Batches are independent of the number of workers."""
    alone, helped = module(root), module(root, workers=2)
    for a, b in zip(alone.train_dataloader(), helped.train_dataloader(), strict=True):
        assert equal(a, b)


def test_an_epoch_and_the_evaluation_have_the_expected_length(root):
    """Lengths follow subjects, batch size, steps_per_epoch and limit;
    evaluation repeats exactly."""
    data = module(root)
    assert len(data.train_dataloader()) == 100  # 50 passes over 3 subjects, 2 at a time
    assert [len(batch.subjects) for batch in data.val_dataloader()] == [2]
    assert [len(b.subjects) for b in data.evaluation_loader(split="train", batch_size=2)] == [2, 1]
    assert len(module(root, steps_per_epoch=7).train_dataloader()) == 7
    assert list(module(root, limit={"train": 2}).subjects("train")) == ["s0", "s1"]
    again = [b for _ in range(2) for b in module(root).val_dataloader()]
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
        ({"views": V4 | {"trainign": "any"}}, "views key: expected one of .*; found 'trainign'"),
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
        ({"limit": {"test": 3}}, "data.limit key: expected one of train, val"),
        ({"limit": {"train": 0}}, "data.limit.train: expected an integer >= 1 or null"),
        ({"workers": -1}, "data.workers: expected an integer >= 0"),
    ],
)
def test_impossible_values_fail_at_once(root, changes, message):
    """A wrong value or key fails when the configuration is read and is named."""
    with pytest.raises(InputError, match=message):
        module(root, **changes)


def test_fewer_views_than_asked(root, tmp_path):
    """Too few cameras are refused with the subject's name; listed positions help."""
    import shutil

    for kind in ("img", "mask", "parm", "depth"):
        for position in (0, 4, 9):
            for phase, name in (("train", "s0"), ("val", "s3")):
                shutil.copytree(
                    root / phase / kind / f"{name}_{position:03d}",
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
        module(root).evaluation_loader(4, {"name": "midway", "per_subject": 5})
    listed = module(tmp_path, evaluation_positions=[[0, 4, 9]], batch_size=1)
    assert next(iter(listed.evaluation_loader(3))).views == (("000/0", "004/0", "009/0"),)


def test_a_subject_alone_is_read_without_targets(root):
    """Four cameras that are all inputs leave no target: a splat needs none."""
    data = module(
        root, targets={"name": "cameras", "view": 0, "training_views": [0], "positions": [0, 4, 8, 12]}
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
def test_a_number_of_views_that_a_ring_does_not_have_is_refused(root, count):
    """0 views were measured as 4, and 17 of 16 took one position twice."""
    with pytest.raises(InputError, match=f"evaluation with {count} views: expected different positions"):
        module(root).evaluation_loader(views=count)


def test_the_seed_of_the_data_reaches_training_and_random_targets(root):
    """Two seeds differ and one repeats, as batches."""
    random = {"name": "random", "per_subject": 3}
    for draw in (
        lambda seed: [
            (b.subjects, b.views, b.targets.names)
            for b in map(module(root, seed=seed).training_batch, range(4))
        ],
        lambda seed: [b.targets.names for b in module(root, seed=seed).evaluation_loader(4, random)],
    ):
        assert draw(0) == draw(0) != draw(1)
