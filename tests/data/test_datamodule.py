"""Options of data sets, splits of subjects, and loading of batches in worker processes."""

import logging
import os
import pickle
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from ghgs_lit.data.batches import choose_workers, make_loader
from ghgs_lit.data.datamodule import count_trained_batches
from ghgs_lit.data.humman import HuMMan
from ghgs_lit.data.layout import read_split, split_names
from ghgs_lit.errors import InputError
from ghgs_people.datasets import Scans, Synthetic
from tests.helpers.captures import refused
from tests.helpers.people import TINY, equal, rendered


def test_keys_of_the_data_set_and_of_its_batches_lie_side_by_side():
    """data.root and data.batch_size are keys of one node, and paths may be ``pathlib`` objects."""
    data = rendered(Path("x"), batch_size=3, workers=1).dataset
    assert data == Scans(root="x", size=[28, 28], batch_size=3, workers=1, render=TINY)
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
    """A misspelt key must not be ignored."""
    message = f"data.{key}: expected one of .*batch_size, .*; found '{key}'{hint}"
    with pytest.raises(InputError, match=message):
        options(size=28, **{key: 1})


def test_evaluation_takes_protocols_and_no_bare_names(tmp_path):
    """A bare name would ignore the protocol's file in conf/targets."""
    with pytest.raises(InputError, match="targets: expected a mapping of its keys; found 'midway'"):
        rendered(tmp_path).evaluation_loader(targets="midway")


@pytest.mark.parametrize(
    ("step", "accumulated", "length", "limit", "batches"),
    [(3, 1, 4, 4, 3), (3, 2, 8, 8, 6), (5, 2, 8, 8, 10), (4, 2, 7, 7, 7), (5, 2, 7, 7, 9), (5, 2, 8, 4, 10)],
)
def test_a_resumed_run_knows_how_many_batches_it_has_had(step, accumulated, length, limit, batches):
    """The count is steps times batches per step, where the last step of an epoch may have fewer batches."""
    trainer = SimpleNamespace(
        global_step=step, accumulate_grad_batches=accumulated, num_training_batches=limit
    )
    assert count_trained_batches(trainer, length) == batches
    assert count_trained_batches(None, length) == 0


def test_depths_are_read_where_something_compares_with_them(boxes):
    """Training without a depth loss reads no depths; evaluation always does."""
    data = rendered(boxes)
    assert data.training_batch(0).depths is not None
    data.trains_on_depths = False
    assert data.training_batch(0).depths is None
    assert data.evaluation_batch("s4").depths is not None


@pytest.mark.parametrize("rank", [0, 1])
def test_each_process_of_several_loads_its_own_samples(boxes, rank, monkeypatch):
    """Rank and world size come from the Trainer, and an epoch has many passes over three subjects."""
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
    assert len(data.train_dataloader().dataset) == 2  # half of the three subjects, rounded up


NAMES = [f"s{i}" for i in range(10)]


def test_a_share_of_the_scans_is_drawn(tmp_path):
    """Without files or lists, the seed determines the split."""
    drawn = split_names(tmp_path, NAMES, None, 0.2, 0)
    assert sorted(drawn["train"] + drawn["val"]) == NAMES
    assert len(drawn["val"]) == 2
    assert drawn == split_names(tmp_path, NAMES, None, 0.2, 0)
    assert drawn != split_names(tmp_path, NAMES, None, 0.2, 1)


@pytest.fixture
def folders(tmp_path):
    """Folders with split files: both files, only the first, and both with a common id."""
    for name, val in (("both", "s3\n"), ("one", None), ("twice", "s2\n")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "split_train.txt").write_text("s1\ns2\n")
        if val:
            (tmp_path / name / "split_val.txt").write_text(val)
    return tmp_path


def test_files_and_lists_decide(folders):
    """A configured split precedes split files, and these precede a random split."""
    listed = {"train": ["s4"], "val": ["s5"]}
    for split, expected in ((None, {"train": ["s1", "s2"], "val": ["s3"]}), (listed, listed)):
        assert split_names(folders / "both", NAMES, split, 0.2, 0) == expected


@pytest.mark.parametrize(
    ("split", "line"),
    [
        ("one", r"split_val\.txt: expected one id a line; found no such file"),
        ("twice", "expected disjoint train and val; found 's2' in both"),
        ("none", r"none: expected a folder with split_train\.txt .*; found no such"),
        ({"train": ["s4"], "val": ["zz"]}, r"expected ids of scans in .*; found 'zz' in val"),
        ({"train": ["s0-s2"], "val": ["s2"]}, r"data\.split: expected disjoint .* found 's2' in both"),
        ({"train": ["s0"]}, r"data\.split: expected a list 'val'"),
    ],
)
def test_bad_splits_are_refused(folders, split, line):
    split = str(folders / split) if isinstance(split, str) else split
    refused(line, lambda: split_names(folders, NAMES, split, 0.2, 0))


def test_ranges_of_ids():
    """Ranges select from the existing ids."""
    names = [f"{i:04d}" for i in range(0, 526, 25)]
    split = read_split({"train": ["0000-0425"], "val": ["0426-0525"]}, names)
    assert (len(split["train"]), len(split["val"])) == (18, 4)


@pytest.mark.parametrize(
    ("count", "fraction", "measured"), [(1, 0.1, 1), (2, 0.1, 1), (4, 0.1, 1), (4, 0.0, 0), (2, 1, 2)]
)
def test_few_scans_leave_somebody_to_validate(tmp_path, count, fraction, measured):
    """A tenth of four scans is rounded up to one; shares of 0 and 1 give none and all."""
    names = [f"s{i}" for i in range(count)]
    drawn = split_names(tmp_path, names, None, fraction, 0)
    assert len(drawn["val"]) == measured
    assert sorted(drawn["train"] + drawn["val"]) == names


MANY = float("inf")


@pytest.mark.parametrize(
    ("count", "processes", "on_gpu", "cores", "expected"),
    [
        (MANY, 1, False, 2, 0),
        (MANY, 1, False, 64, 0),
        (MANY, 1, True, 1, 1),
        (MANY, 1, True, 2, 1),
        (MANY, 1, True, 6, 5),
        (MANY, 8, True, 16, 1),
        (MANY, 8, True, 96, 8),
        (100, 1, True, 96, 0),
        (1000, 1, True, 96, 8),
    ],
)
def test_processes_by_cores_devices_and_batches(count, processes, on_gpu, cores, expected):
    """With a GPU the cores load data, with a CPU they do not, and few batches do not justify workers."""
    assert choose_workers(count, processes, on_gpu, cores) == expected


def test_automatic_processes_are_said_once_and_load_the_same(boxes, caplog):
    """Training logs the number of workers once; evaluation with few batches starts none and logs nothing."""
    with caplog.at_level(logging.INFO):
        data = rendered(boxes, workers="auto", steps_per_epoch=3)
        loader = data.train_dataloader()
        assert loader.num_workers == choose_workers(MANY, 1, False)
        assert data.val_dataloader().num_workers == 0
    assert sum("data.workers=auto" in record.message for record in caplog.records) == 1
    expected = rendered(boxes, workers=0, steps_per_epoch=3).train_dataloader()
    assert all(map(equal, loader, expected))


def test_batches_can_be_sent_to_processes_that_begin_anew(boxes):
    """Datasets can be pickled for spawned workers, as on macOS."""
    batches = rendered(boxes, augmentation={"exposure": 0.1}).train_dataloader().dataset
    batches[0]
    assert equal(pickle.loads(pickle.dumps(batches))[1], batches[1])


_TRAINING = """
import sys
from tests.helpers.people import rendered
batches = iter(rendered(sys.argv[1], workers=2, steps_per_epoch=10**6).train_dataloader())
next(batches)
try:
    print(*[process.pid for process in batches._workers], flush=True)
    while True:
        next(batches)
except KeyboardInterrupt:
    print("interrupted", flush=True)
"""


class Signalled:
    """Dataset whose items send its process SLURM's signal of an announced end."""

    def __len__(self):
        return 3

    def __getitem__(self, index):
        os.kill(os.getpid(), signal.SIGUSR2)
        return index


def test_an_announced_end_leaves_loading_to_the_training():
    """SLURM sends the signal to all processes of a job; workers must ignore it and not end the training."""
    assert list(make_loader(Signalled(), 1)) == [0, 1, 2]


def test_an_interrupt_ends_all_processes_without_their_traces(boxes):
    """A terminal sends Ctrl-C to all processes; only the training process handles it."""
    process = subprocess.Popen(
        [sys.executable, "-c", _TRAINING, str(boxes)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        cwd=Path(__file__).parents[2],
    )
    children = [int(number) for number in process.stdout.readline().split()]
    assert len(children) == 2
    os.killpg(process.pid, signal.SIGINT)
    said, errors = process.communicate(timeout=60)
    assert (said.strip(), process.returncode) == ("interrupted", 0)
    assert "KeyboardInterrupt" not in errors
    deadline = time.monotonic() + 20
    while any(map(is_running, children)):
        assert time.monotonic() < deadline
        time.sleep(0.05)


def is_running(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    return True
