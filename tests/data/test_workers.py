"""Loading processes: how many are chosen, that they may start in any way, and how they end."""

import logging
import os
import pickle
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from ghgs_lit.data.batches import automatic_workers, loader_of
from tests.helpers.people import equal, rendered

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
        (20, 1, True, 96, 0),
        (100, 1, True, 96, 8),
    ],
)
def test_processes_by_cores_devices_and_batches(monkeypatch, count, processes, on_gpu, cores, expected):
    """A GPU leaves the cores to loading, a CPU none;
    a few batches come sooner than a process starts."""
    monkeypatch.setattr("ghgs_lit.data.batches.multiprocessing.get_start_method", lambda: "fork")
    assert automatic_workers(count, processes, on_gpu, cores) == expected


def test_processes_that_import_pytorch_first_start_for_more_batches(monkeypatch):
    """As on macOS, where a start takes seconds."""
    monkeypatch.setattr("ghgs_lit.data.batches.multiprocessing.get_start_method", lambda: "spawn")
    assert automatic_workers(100, 1, True, 96) == 0
    assert automatic_workers(1000, 1, True, 96) == 8


def test_automatic_processes_are_said_once_and_load_the_same(boxes, caplog):
    """Evaluation with its few batches starts none and says nothing."""
    with caplog.at_level(logging.INFO):
        data = rendered(boxes, workers="auto", steps_per_epoch=3)
        loader = data.train_dataloader()
        assert loader.num_workers == automatic_workers(MANY, 1, False)
        assert data.val_dataloader().num_workers == 0
    assert sum("data.workers=auto" in record.message for record in caplog.records) == 1
    expected = rendered(boxes, workers=0, steps_per_epoch=3).train_dataloader()
    assert all(map(equal, loader, expected))


def test_batches_can_be_sent_to_processes_that_begin_anew(boxes):
    """All that a spawned process receives, as on macOS."""
    batches = rendered(boxes, augmentation={"gamma": 0.1}).train_dataloader().dataset
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
    """Batches, whose process gets the signal of an announced end with each."""

    def __len__(self):
        return 3

    def __getitem__(self, index):
        os.kill(os.getpid(), signal.SIGUSR2)
        return index


def test_an_announced_end_leaves_loading_to_the_training():
    """SLURM sends the signal to all processes of a job; a worker ended, and with it the training."""
    assert list(loader_of(Signalled(), 1)) == [0, 1, 2]


def test_an_interrupt_ends_all_processes_without_their_traces(boxes):
    """A terminal sends Ctrl-C to all of them; only the one that trains answers."""
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
