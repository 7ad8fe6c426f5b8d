"""Interrupted sweeps: their messages, and how they continue."""

import contextlib
import itertools
import os
import signal
import time

import pytest

from ghgs_lit.cli import application
from ghgs_lit.cli import train as train_verb
from ghgs_lit.errors import InputError
from ghgs_lit.runs import sweep as sweep_module
from ghgs_lit.runs.run import RunDirectory
from tests.helpers.jobs import (
    executed,
    record_execution,
)

pytestmark = pytest.mark.usefixtures("plans_alone")


def test_an_interrupted_run_resumes_and_a_failed_one_is_tried_again(sweep, monkeypatch):
    """After Ctrl-C the same command resumes from the checkpoint and restarts failed runs."""

    def bad(run, directory, stats):
        if run.seed == 1:
            raise InputError("step 3: expected finite losses; found nan")
        if run.seed == 2:
            (directory / "checkpoints").mkdir()
            (directory / "checkpoints" / "last.ckpt").touch()
            raise KeyboardInterrupt
        return record_execution(run, directory, stats)

    monkeypatch.setattr(train_verb, "train", bad)
    code, _, _ = sweep("seed=3,1,2,4")
    assert code == 130
    assert len(executed(sweep.directory)) == 1
    # tables list planned runs as missing
    assert len(list(sweep.directory.glob("*/config.yaml"))) == 4
    _, out, _ = sweep("seed=1,2,3,4", "dry_run=true")
    assert "4 runs: 1 done, 2 missing, 1 partial" in out
    monkeypatch.setattr(train_verb, "train", record_execution)
    out = sweep.succeed("seed=1,2,3,4")
    assert "4 runs: 4 done" in out
    lines = [line.split() for line in (sweep.directory / "executed").read_text().splitlines()]
    resumed = {name: resume for name, _, resume in lines}
    assert len(lines) == len(resumed) == 4
    cut = [name for name, resume in resumed.items() if resume != "None"]
    assert len(cut) == 1
    assert resumed[cut[0]] == str(sweep.directory / cut[0] / "checkpoints" / "last.ckpt")
    outcomes = [s.get("outcome") for s in RunDirectory(sweep.directory / cut[0]).sessions()]
    assert outcomes == ["interrupted", "done"]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_sweep_that_is_stopped_starts_no_further_run(sweep, monkeypatch, number):
    """Batch systems and ``&&`` evaluate the exit code; the message contains the command to continue."""

    def stopped(run, directory, stats):
        (directory / "started").touch()
        os.kill(os.getpid(), number)
        time.sleep(10)

    monkeypatch.setattr(train_verb, "train", stopped)
    code, _, err = sweep("seed=1,2,3")
    assert code == 128 + number
    assert len(list(sweep.directory.glob("*/started"))) == 1
    (line,) = [line for line in err.splitlines() if "to go on" in line]
    assert f"hydra.sweep.dir={sweep.directory}" in line
    monkeypatch.setattr(train_verb, "train", record_execution)
    out = sweep.succeed("seed=1,2,3")
    assert "3 runs: 3 done" in out


def stop_in_third_plan(monkeypatch, number, is_lost):
    """Send a signal while the third configuration of a sweep is processed.

    OmegaConf restores flags in a ``finally`` block, where an interruption becomes an ``AttributeError``;
    code that catches one, such as ``hasattr``, loses the signal.
    """
    whole = sweep_module.config_hash
    calls = itertools.count(1)

    def interrupted(config):
        if next(calls) != 3:
            return whole(config)
        with contextlib.suppress(AttributeError) if is_lost else contextlib.nullcontext():
            try:
                os.kill(os.getpid(), number)
            finally:
                raise AttributeError("'NoneType' object has no attribute '_invalidate_flags_cache'")
        return whole(config)

    monkeypatch.setattr(sweep_module, "config_hash", interrupted)
    return calls


@pytest.mark.parametrize("is_lost", [False, True])
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_sweep_that_is_stopped_while_it_is_planned_starts_nothing(sweep, monkeypatch, number, is_lost):
    """Regression: the sweep continued, or its message contained an invalid override."""
    calls = stop_in_third_plan(monkeypatch, number, is_lost)
    code, _, err = sweep("seed=1,2,3,4,5")
    assert code == 128 + number
    name = signal.Signals(number).name
    how = f"to go on, the same command with hydra.sweep.dir={sweep.directory}"
    assert err == f"ghgs: the sweep was interrupted ({name}); {how}\n"
    assert next(calls) == 4
    assert not sweep.directory.exists()
    code, out, _ = sweep("seed=1,2", "dry_run=true")
    assert (code, "2 runs: 2 missing" in out) == (0, True)


def test_a_sweep_that_is_stopped_between_two_runs_starts_no_further_run(sweep, monkeypatch):
    """The signal arrives while the second run fills in its configuration, which then fails."""

    def then_stop(run, directory, stats):
        monkeypatch.setattr(application, "fill", loses_a_signal)
        return record_execution(run, directory, stats)

    def loses_a_signal(cfg):
        try:
            os.kill(os.getpid(), signal.SIGTERM)
        finally:
            raise AttributeError("flags")

    monkeypatch.setattr(train_verb, "train", then_stop)
    code, _, err = sweep("seed=1,2,3")
    assert code == 143
    assert "to go on, the same command with hydra.sweep.dir=" in err
    assert "Traceback" not in err
    assert len(executed(sweep.directory)) == 1
