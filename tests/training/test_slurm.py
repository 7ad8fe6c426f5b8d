"""SLURM jobs: their processes, and their continuation after they are requeued."""

import datetime
import itertools
import os
import signal
from unittest.mock import Mock

import pytest

from ghgs_lit.cli import train as train_verb
from ghgs_lit.cli.train import build_trainer
from ghgs_lit.config import run_of
from ghgs_lit.errors import InputError
from ghgs_lit.runs import processes
from ghgs_lit.runs.run import RunDirectory
from tests.cli.test_main import call
from tests.helpers.jobs import record_execution

BATCH = {
    "SLURM_JOB_ID": "1234",
    "SLURM_JOB_NAME": "train",
    "SLURM_NNODES": "1",
    "SLURM_NODEID": "0",
    "SLURM_JOB_NODELIST": "localhost",
    "SLURM_NTASKS": "4",
    "SLURM_PROCID": "0",
    "SLURM_LOCALID": "0",
}


def test_tasks_of_a_batch_script_are_no_processes(monkeypatch, tmp_path):
    """``#SBATCH --ntasks=4`` only allocates cores; only ``srun`` starts that many processes."""
    run = run_of("train", ["trainer=cpu", "logger=none", "callbacks=none"])
    for name, value in BATCH.items():
        monkeypatch.setenv(name, value)
    monkeypatch.delenv("SLURM_STEP_ID", raising=False)
    monkeypatch.delenv("SRUN_DEBUG", raising=False)
    assert build_trainer(run, tmp_path).world_size == 1
    monkeypatch.setenv("SLURM_STEP_ID", "0")
    with pytest.raises(InputError, match=r"trainer: .*--ntasks-per-node=4"):
        build_trainer(run, tmp_path)
    monkeypatch.setenv("SLURM_NTASKS", "1")
    (environment,) = train_verb.environments()  # Lightning's handler would save within a step
    assert (environment.world_size(), environment.auto_requeue) == (1, False)


@pytest.fixture
def task(monkeypatch, tmp_path):
    """Set the environment of ``srun`` and a new working directory; returns the file to which requests to
    SLURM are written. Directories are named by the time, which is a second later at each look."""
    start, seconds = datetime.datetime(2026, 1, 1), itertools.count()
    clock = Mock(now=lambda: start + datetime.timedelta(seconds=next(seconds)))
    monkeypatch.setattr("hydra.core.utils.datetime", clock)
    for name, value in (BATCH | {"SLURM_NTASKS": "1", "SLURM_STEP_ID": "0"}).items():
        monkeypatch.setenv(name, value)
    monkeypatch.delenv("SLURM_RESTART_COUNT", raising=False)
    requests, program = tmp_path / "requests", tmp_path / "bin" / "scontrol"
    program.parent.mkdir()
    program.write_text(f'#!/bin/bash\necho "$@" >> {requests}\n')
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{program.parent}:{os.environ['PATH']}")
    monkeypatch.chdir(tmp_path)
    return requests


def stop_with(number):
    def train(run, directory, stats):
        (directory / "checkpoints").mkdir()
        (directory / "checkpoints" / "last.ckpt").write_text(str(run.seed))
        os.kill(os.getpid(), number)

    return train


@pytest.mark.parametrize(
    "places",
    [
        ("seed=3",),
        ("-m", "seed=3,4"),
        ("-m", "seed=3,4", "hydra/sweeper=basic"),
        ("-m", "seed=3,4", "hydra/sweeper=basic", "hydra.sweep.dir=mine"),
        ("seed=3", "hydra.run.dir=mine"),
    ],
)
@pytest.mark.parametrize("number", [signal.SIGUSR1, signal.SIGTERM])
def test_a_job_that_is_queued_again_goes_on(monkeypatch, capsys, task, places, number):
    """The same command resumes in its directory, instead of starting anew or being rejected. SLURM itself
    requeues a job that ends early, and requeues one whose time is up (SIGUSR1) on request."""
    monkeypatch.setattr(train_verb, "train", stop_with(number))
    code, _, err = call(monkeypatch, capsys, "train", *places)
    assert code == 128 + number
    assert ("SLURM queues its job again" in err) == task.exists() == (number == signal.SIGUSR1)
    assert not task.exists() or task.read_text() == "requeue 1234\n"
    monkeypatch.setenv("SLURM_RESTART_COUNT", "1")
    monkeypatch.setattr(train_verb, "train", record_execution)
    code, _, err = call(monkeypatch, capsys, "train", *places)
    assert code == 0, err
    (begun,) = (path.parents[1] for path in task.parent.rglob("last.ckpt"))
    outcomes = [s["outcome"] for s in RunDirectory(begun).sessions()]
    assert outcomes == ["interrupted", "done"]
    assert RunDirectory(begun).sessions()[1]["resumed"] == "checkpoints/last.ckpt"
    assert len(list(task.parent.rglob("metrics.json"))) == (2 if "-m" in places else 1)


def test_a_sweep_without_its_command_begins_anew(monkeypatch, capsys, task):
    """Other sweepers may write no multirun.yaml, which was an error."""
    command = ("train", "-m", "seed=3,4", "hydra/sweeper=basic")
    monkeypatch.setattr(train_verb, "train", stop_with(signal.SIGTERM))
    assert call(monkeypatch, capsys, *command)[0] == 143
    next(task.parent.rglob("multirun.yaml")).unlink()
    monkeypatch.setenv("SLURM_RESTART_COUNT", "1")
    monkeypatch.setattr(train_verb, "train", record_execution)
    code, _, err = call(monkeypatch, capsys, *command)
    assert code == 0, err
    assert len({path.parents[1] for path in task.parent.rglob("metrics.json")}) == 1


def test_a_job_that_was_not_queued_again_begins_anew(monkeypatch, capsys, task):
    """A second command in an interactive job is a new run."""
    monkeypatch.setattr(train_verb, "train", stop_with(signal.SIGTERM))
    assert call(monkeypatch, capsys, "train", "hydra.run.dir=runs/train/1")[0] == 143
    monkeypatch.setattr(train_verb, "train", record_execution)
    assert call(monkeypatch, capsys, "train")[0] == 0
    assert not (task.parent / "runs" / "train" / "1" / "metrics.json").exists()
    monkeypatch.setenv("SLURM_RESTART_COUNT", "1")
    monkeypatch.setenv("SLURM_JOB_ID", "1235")
    assert call(monkeypatch, capsys, "train", "seed=3")[0] == 0
    assert not (task.parent / "runs" / "train" / "1" / "metrics.json").exists()


def test_only_tasks_of_srun_are_queued_again(monkeypatch, task):
    """A batch script without ``srun`` is not requeued; jobs of arrays are requeued by both of their
    numbers."""
    monkeypatch.setenv("SLURM_ARRAY_JOB_ID", "1230")
    monkeypatch.setenv("SLURM_ARRAY_TASK_ID", "4")
    assert processes.queue_again(signal.SIGUSR1)
    assert not processes.queue_again(signal.SIGTERM)
    monkeypatch.setenv("SLURM_JOB_NAME", "interactive")
    assert not processes.queue_again(signal.SIGUSR1)
    monkeypatch.delenv("SLURM_JOB_NAME")
    monkeypatch.delenv("SLURM_STEP_ID")
    assert not processes.queue_again(signal.SIGUSR1)
    assert task.read_text() == "requeue 1230_4\n"
    monkeypatch.setenv("SLURM_STEP_ID", "0")
    monkeypatch.setenv("PATH", "")
    assert not processes.queue_again(signal.SIGUSR1)


def test_processes_that_start_together_take_the_start_of_the_first(monkeypatch, tmp_path):
    """The other processes wait for the first one of the same start, and resume if it does."""
    from ghgs_lit.runs import job

    monkeypatch.setattr(job, "_PATIENCE", 0.3)
    run = run_of("train")
    seen = []

    def first(_, directory, stats):
        monkeypatch.setattr(job, "_PATIENCE", 0.0)
        job.join_training(place, run, lambda run, *_: seen.append(run.resume))
        (directory / "checkpoints").mkdir(exist_ok=True)
        (directory / "checkpoints" / "last.ckpt").touch()
        raise KeyboardInterrupt

    place = RunDirectory(tmp_path)
    for _ in range(2):
        with pytest.raises(KeyboardInterrupt):
            job.train_once(place, run, first)
    with pytest.raises(InputError, match="the first process of this training"):
        job.join_training(place, run, lambda *_: seen.append("wrong"))
    assert seen == [None, str(tmp_path / "checkpoints" / "last.ckpt")]
