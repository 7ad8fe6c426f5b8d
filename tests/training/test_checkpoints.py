"""Checkpoints are written atomically; on Ctrl-C and SIGTERM a run finishes its step, saves, exits with
the signal's code, and resumes to the same result."""

import os
import signal
import threading
from subprocess import CalledProcessError

import lightning.pytorch as L
import pytest
import torch

from ghgs_lit.cli.train import build_trainer
from ghgs_lit.config import run_of
from ghgs_lit.runs import processes
from ghgs_lit.runs.processes import Interrupted, handlers, interruptible
from ghgs_lit.training.checkpoints import AfterSteps, AtomicCheckpointIO, CheckpointOptions, StopAtStep
from tests.training.test_resume import Cut, fit, rows


def test_kill_while_writing_leaves_the_checkpoint_before(tmp_path, monkeypatch):
    """A kill while writing loses no previous checkpoint and wastes no disk space."""
    path, files = tmp_path / "last.ckpt", AtomicCheckpointIO()
    files.save_checkpoint({"step": 1, "weights": torch.arange(1000.0)}, path)
    child = os.fork()
    if child == 0:

        def half(content, path):
            path.write_bytes(b"half a checkpoint")
            os.kill(os.getpid(), signal.SIGKILL)

        monkeypatch.setattr(torch, "save", half)
        files.save_checkpoint({"step": 2}, path)
        os._exit(0)
    _, status = os.waitpid(child, 0)
    assert os.WIFSIGNALED(status)
    assert os.WTERMSIG(status) == signal.SIGKILL
    assert files.load_checkpoint(path)["step"] == 1
    monkeypatch.undo()
    files.save_checkpoint({"step": 3}, path)
    assert files.load_checkpoint(path)["step"] == 3
    assert [p.name for p in tmp_path.iterdir()] == ["last.ckpt"]


def test_the_rename_comes_after_the_disk_has_all(tmp_path, monkeypatch):
    """The file is synced before it is renamed, so that its content survives a power cut."""
    calls = []
    for name in ("fsync", "replace"):
        real = getattr(os, name)
        monkeypatch.setattr(os, name, lambda *a, _n=name, _r=real: (calls.append(_n), _r(*a)))
    AtomicCheckpointIO().save_checkpoint({"step": 1}, tmp_path / "a.ckpt")
    assert calls == ["fsync", "replace", "fsync"]


def test_the_best_checkpoint_is_found_where_the_run_is(tmp_path, recwarn):
    """The state contains file names, not folders, so that a run can be moved; the score of a checkpoint
    that no longer exists does not prevent later ones."""
    old, new = tmp_path / "old" / "checkpoints", tmp_path / "new" / "checkpoints"
    before, after = (CheckpointOptions(filename="best", monitor="val/psnr").build() for _ in range(2))
    before.dirpath, after.dirpath = str(old), str(new)
    path, score = str(old / "best.ckpt"), torch.tensor(30.0)
    before.best_model_path = before.kth_best_model_path = path
    before.best_model_score = before.kth_value = score
    before.best_k_models = {path: score}
    state = before.state_dict()
    assert str(tmp_path) not in str(state)
    after.load_state_dict(state)
    assert (after.best_model_path, after.best_model_score, after.best_k_models) == ("", None, {})
    new.mkdir(parents=True)
    (new / "best.ckpt").touch()
    after.load_state_dict(state)
    assert after.best_model_path == after.kth_best_model_path == str(new / "best.ckpt")
    assert (after.best_k_models, after.best_model_score) == ({str(new / "best.ckpt"): score}, score)
    assert not recwarn.list


def test_a_state_names_no_file_of_other_folders(tmp_path):
    """Paths are restricted to the run's folder, as Lightning deletes the file that a state lists as the
    worst checkpoint."""
    subject = CheckpointOptions(filename="best", monitor="val/psnr").build()
    subject.dirpath = str(tmp_path / "run" / "checkpoints")
    (tmp_path / "run" / "checkpoints").mkdir(parents=True)
    (tmp_path / "run" / "checkpoints" / "a.ckpt").touch()
    state = subject.state_dict() | {"best_k_models": {"../../a.ckpt": torch.tensor(1.0)}}
    subject.load_state_dict(state | {"kth_best_model_path": "/etc/a.ckpt", "best_model_path": "../a.ckpt"})
    own = str(tmp_path / "run" / "checkpoints" / "a.ckpt")
    assert {subject.kth_best_model_path, subject.best_model_path, *subject.best_k_models} == {own}


class Signal(L.Callback):
    """Sends a signal to this process in step ``at`` (counted from 1), or in the validation after it."""

    def __init__(self, at: int, number: int, validating: bool = False, times: int = 1):
        self.at, self.number, self.validating, self.times = at, number, validating, times
        self.also: int | None = None

    def on_train_batch_start(self, trainer, *_):
        if trainer.global_step + 1 == self.at and not self.validating:
            for _ in range(self.times):
                os.kill(os.getpid(), self.number)
            if self.also is not None:
                os.kill(os.getpid(), self.also)

    def on_validation_batch_start(self, trainer, *_):
        if trainer.global_step == self.at and self.validating:
            os.kill(os.getpid(), self.number)


def train_until_signal(folder, sender: Signal) -> int:
    """Train until the signal, and return the exit code."""
    with pytest.raises(Interrupted) as stop, interruptible():
        fit(folder, Cut(), more=[sender, StopAtStep()])
    return stop.value.code


@pytest.mark.parametrize(
    ("number", "at", "validating", "accumulate"),
    [
        (signal.SIGINT, 5, False, 1),
        (signal.SIGTERM, 7, False, 1),
        (signal.SIGTERM, 8, False, 1),
        (signal.SIGINT, 8, True, 1),
        (signal.SIGTERM, 6, False, 2),
        (signal.SIGUSR1, 5, False, 1),
        (signal.SIGUSR2, 8, True, 1),
    ],
)
def test_a_run_that_is_stopped_goes_on_as_if_it_had_not_been(
    whole, tmp_path, number, at, validating, accumulate
):
    """The step and a due validation are finished and saved, so that weights, logs and validations agree
    with those of an uninterrupted run."""
    options = {"accumulate_grad_batches": accumulate}
    folder, expected, validations = whole(accumulate)
    before = handlers()
    first = Cut()
    with pytest.raises(Interrupted) as stop, interruptible():
        fit(tmp_path / "cut", first, more=[Signal(at, number, validating), StopAtStep()], **options)
    assert stop.value.code == 128 + number
    assert handlers() == before
    last = tmp_path / "cut" / "checkpoints" / "last.ckpt"
    assert torch.load(last, weights_only=True)["global_step"] == at
    second = Cut()
    subject = fit(tmp_path / "cut", second, resume=last, **options)
    for a, b in zip(expected.parameters(), subject.parameters(), strict=True):
        assert torch.equal(a, b)
    assert first.validations + second.validations == validations
    assert rows(tmp_path / "cut") == rows(folder)


def test_a_checkpoint_at_a_signal_follows_the_best_one(tmp_path):
    """Regression: a signal before a validation saved the best score of the one before."""
    trainer = build_trainer(run_of("train"), tmp_path, StopAtStep())
    assert isinstance(trainer.callbacks[-1], StopAtStep)


def test_nothing_is_saved_between_the_parts_of_a_step(tmp_path):
    """A checkpoint between them would lose the gradients so far."""

    class Steps(AfterSteps):
        def after_step(self, trainer, pl_module):
            steps.append(trainer.global_step)

    steps = []
    fit(tmp_path, Cut(), more=[Steps()], accumulate_grad_batches=2, limit_val_batches=0)
    assert steps == sorted(set(steps))


def test_a_second_signal_stops_at_once(tmp_path, monkeypatch):
    """A repeated signal does not wait for the step, but one signal that is delivered twice counts once."""
    assert train_until_signal(tmp_path / "twice", Signal(5, signal.SIGINT, times=2)) == 130
    assert (tmp_path / "twice" / "checkpoints" / "last.ckpt").exists()
    monkeypatch.setattr("ghgs_lit.training.checkpoints._SAME", -1.0)
    assert train_until_signal(tmp_path / "now", Signal(2, signal.SIGTERM, times=2)) == 143
    assert not (tmp_path / "now" / "checkpoints" / "last.ckpt").exists()


def test_a_batch_system_that_announces_and_then_asks_gets_a_checkpoint(tmp_path, monkeypatch):
    """SIGTERM after SIGUSR1 still leaves time to finish the step."""
    monkeypatch.setattr("ghgs_lit.training.checkpoints._SAME", -1.0)
    sender = Signal(5, signal.SIGUSR1)
    sender.also = signal.SIGTERM
    assert train_until_signal(tmp_path, sender) == 128 + signal.SIGUSR1
    assert torch.load(tmp_path / "checkpoints" / "last.ckpt", weights_only=True)["global_step"] == 5


@pytest.mark.parametrize("error", [None, SystemExit(255), CalledProcessError(-15, "scontrol")])
def test_a_batch_system_that_handles_signals_gets_a_checkpoint(tmp_path, error):
    """submitit ignores SIGTERM and requeues on SIGUSR2. The step is saved before its handler, which exits
    the process, returns (in processes other than the job's first), or fails because the job is ended."""
    seen = []

    def requeue(number, _):
        last = torch.load(tmp_path / "checkpoints" / "last.ckpt", weights_only=True)
        seen.append((number, last["global_step"]))
        if error is not None:
            raise error

    own = {signal.SIGTERM: lambda number, _: seen.append(number), signal.SIGUSR2: requeue}
    before = {number: signal.signal(number, handler) for number, handler in own.items()}
    senders = [Signal(3, signal.SIGTERM), Signal(5, signal.SIGUSR2)]
    try:
        with pytest.raises(SystemExit) as stop, interruptible():
            fit(tmp_path, Cut(), more=[*senders, StopAtStep()])
        assert handlers()[signal.SIGUSR2] is requeue
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    assert seen == [signal.SIGTERM, (signal.SIGUSR2, 5)]
    assert stop.value.code == (255 if isinstance(error, SystemExit) else 128 + signal.SIGUSR2)


def test_forked_workers_do_not_act_for_their_parent():
    """A worker that inherits the handlers must be killed by SIGTERM, and leave Ctrl-C to its parent."""
    with interruptible():
        child = os.fork()
        if child == 0:
            os.kill(os.getpid(), signal.SIGINT)
            os.kill(os.getpid(), signal.SIGTERM)
            os._exit(0)
        _, status = os.waitpid(child, 0)
    assert os.WTERMSIG(status) == signal.SIGTERM


def test_other_threads_change_no_handlers():
    """Python rejects handlers outside the main thread, where some launchers run their jobs."""
    before, errors = handlers(), []

    def work():
        try:
            with interruptible():
                processes.handle(processes.interrupt, before)
        except ValueError as error:
            errors.append(error)

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert (errors, handlers()) == ([], before)
