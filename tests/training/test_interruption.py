"""Ctrl-C and SIGTERM while training: a checkpoint after the step, exit codes, and the same end."""

import os
import signal
import threading
from subprocess import CalledProcessError

import lightning.pytorch as L
import pytest
import torch

from ghgs_lit.runs import signals
from ghgs_lit.runs.signals import Interrupted, handlers, interruptible
from ghgs_lit.training.checkpoints import StopAtStep
from tests.training.test_resume import Cut, fit, rows


class Signal(L.Callback):
    """Sends a signal to this process in step ``at`` (counted from 1),
    or in the validation after it."""

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


def stopped(folder, sender: Signal) -> int:
    """Train until the signal; returns the exit code."""
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
    """The step and a validation that is due are finished and saved: weights,
    logs and validations agree."""
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


def test_a_second_signal_stops_at_once(tmp_path, monkeypatch):
    """Who does not want to wait for the step is not made to;
    one signal that arrives twice is one."""
    assert stopped(tmp_path / "twice", Signal(5, signal.SIGINT, times=2)) == 130
    assert (tmp_path / "twice" / "checkpoints" / "last.ckpt").exists()
    monkeypatch.setattr("ghgs_lit.training.checkpoints._SAME", -1.0)
    assert stopped(tmp_path / "now", Signal(2, signal.SIGTERM, times=2)) == 143
    assert not (tmp_path / "now" / "checkpoints" / "last.ckpt").exists()


def test_a_batch_system_that_announces_and_then_asks_gets_a_checkpoint(tmp_path, monkeypatch):
    """SIGTERM after SIGUSR1 does not mean that nobody waits for the step."""
    monkeypatch.setattr("ghgs_lit.training.checkpoints._SAME", -1.0)
    sender = Signal(5, signal.SIGUSR1)
    sender.also = signal.SIGTERM
    assert stopped(tmp_path, sender) == 128 + signal.SIGUSR1
    assert torch.load(tmp_path / "checkpoints" / "last.ckpt", weights_only=True)["global_step"] == 5


@pytest.mark.parametrize("error", [None, SystemExit(255), CalledProcessError(-15, "scontrol")])
def test_a_batch_system_that_handles_signals_gets_a_checkpoint(tmp_path, error):
    """submitit ignores SIGTERM and requeues on SIGUSR2, before which the step is saved; its handler
    ends the process, returns where it is not the job's first, or fails as the job is ended."""
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
    """A worker that inherits the handlers must die of SIGTERM, and leave Ctrl-C to its parent."""
    with interruptible():
        child = os.fork()
        if child == 0:
            os.kill(os.getpid(), signal.SIGINT)
            os.kill(os.getpid(), signal.SIGTERM)
            os._exit(0)
        _, status = os.waitpid(child, 0)
    assert os.WTERMSIG(status) == signal.SIGTERM


def test_other_threads_change_no_handlers():
    """Python refuses handlers outside of the main thread, where some launchers run their jobs."""
    before, errors = handlers(), []

    def work():
        try:
            with interruptible():
                signals.handle(signals.interrupt, before)
        except ValueError as error:
            errors.append(error)

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert (errors, handlers()) == ([], before)
