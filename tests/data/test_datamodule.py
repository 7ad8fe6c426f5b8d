"""Options of data sets: one flat mapping, checked,
with the keys of the data set and of its batches."""

from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from ghgs_lit.data.datamodule import trained_batches
from ghgs_lit.data.humman import HuMMan
from ghgs_lit.errors import InputError
from ghgs_people.datasets import Scans, Synthetic
from tests.helpers.people import TINY, rendered


def test_keys_of_the_data_set_and_of_its_batches_lie_side_by_side():
    """Documented commands set data.root and data.batch_size in one node;
    a path may be one of Python's."""
    data = rendered(Path("x"), batch_size=3, limit={"val": 2}, workers=1).dataset
    assert data == Scans(root="x", size=[28, 28], batch_size=3, limit={"val": 2}, workers=1, render=TINY)
    assert [data.limit.of(phase) for phase in ("train", "val", "bench")] == [None, 2, None]
    assert (data.size, data.target_size) == ((28, 28), None)
    assert (data.batch_size, data.workers) == (3, 1)


@pytest.mark.parametrize(
    ("options", "key", "hint"),
    [
        (Scans, "batchsize", r" \(did you mean batch_size"),
        (HuMMan, "smpl_modell", r" \(did you mean smpl_model"),
        (HuMMan, "pixel_centers", ""),
        (Synthetic, "root", ""),
    ],
)
def test_a_wrong_key_is_named(options, key, hint):
    """A misspelt key must never be swallowed."""
    with pytest.raises(InputError, match=f"data key: expected one of .*batch_size, .*; found '{key}'{hint}"):
        options(size=28, **{key: 1})


def test_evaluation_takes_protocols_and_no_bare_names(tmp_path):
    """A name alone would ignore the file of the protocol in conf/targets."""
    with pytest.raises(InputError, match="targets: expected a mapping of its keys; found 'midway'"):
        rendered(tmp_path).evaluation_loader(targets="midway")


@pytest.mark.parametrize(
    ("step", "accumulated", "length", "limit", "batches"),
    [(3, 1, 4, 4, 3), (3, 2, 8, 8, 6), (5, 2, 8, 8, 10), (4, 2, 7, 7, 7), (5, 2, 7, 7, 9), (5, 2, 8, 4, 10)],
)
def test_a_resumed_run_knows_how_many_batches_it_has_had(step, accumulated, length, limit, batches):
    """Steps times the batches of a step; the last step of an epoch takes those that are left."""
    trainer = SimpleNamespace(
        global_step=step, accumulate_grad_batches=accumulated, num_training_batches=limit
    )
    assert trained_batches(trainer, length) == batches
    assert trained_batches(None, length) == 0


def test_depths_are_read_where_something_compares_with_them(boxes):
    """Training without a term of depths reads none; evaluation measures depths all the same."""
    data = rendered(boxes)
    assert data.training_batch(0).depths is not None
    data.trains_on_depths = False
    assert data.training_batch(0).depths is None
    assert data.evaluation_batch("s4").depths is not None


@pytest.mark.parametrize("rank", [0, 1])
def test_each_process_of_several_loads_its_own_samples(boxes, rank, monkeypatch):
    """Its number and how many there are come from the trainer;
    three subjects are passed often in an epoch."""
    data = rendered(boxes, batch_size=1)
    data.trainer = SimpleNamespace(world_size=2, global_rank=rank, max_steps=-1, max_epochs=None)
    data.trainer.num_devices = 2
    data.trainer.strategy = SimpleNamespace(root_device=torch.device("cpu"))
    batches = data.train_dataloader().dataset
    assert (batches.rank, batches.world, len(batches)) == (rank, 2, 100)
    drawn = data.training_sampler()
    for step in range(2):
        expected = [sample.subject for sample in drawn.batch(step, rank, 2)]
        assert list(batches[step].subjects) == expected
    monkeypatch.setattr("ghgs_lit.data.datamodule.LEAST_STEPS", 1)
    assert len(data.train_dataloader().dataset) == 2  # of the three subjects, each process has half
