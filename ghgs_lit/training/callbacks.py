"""Callback that says how far a run is."""

import time
from pathlib import Path
from typing import Any

import lightning.pytorch as L
from lightning.pytorch.callbacks import Callback

from ghgs_lit.config.options import Options
from ghgs_lit.runs.progress import EVERY, EVERY_ON_TERMINAL, Lines, clock, on_terminal


class ProgressOptions(Options):
    """Lines on the progress of the run over its budget of steps or time."""

    def build(self) -> "RunProgress":
        return RunProgress()


class RunProgress(Callback):
    """Prints how far the run is, every ten seconds on a terminal and every minute elsewhere, and appends the
    lines to ``<run>/train.log``."""

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        every = EVERY_ON_TERMINAL if on_terminal() else EVERY
        self._lines = Lines(Path(trainer.default_root_dir) / "train.log", every)
        self._first = None  # time, step and used budget of the first line, then of the last one
        self._last = (time.monotonic(), trainer.global_step, pl_module.used_budget)

    def on_train_batch_end(self, trainer: L.Trainer, pl_module: L.LightningModule, *args: Any) -> None:
        # Nothing is new between two parts of an accumulated step.
        if trainer.is_global_zero and trainer.global_step > self._last[1] and self._lines.due():
            self._say(trainer, pl_module)

    def _say(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        now = (time.monotonic(), trainer.global_step, pl_module.used_budget)
        total = f" of {trainer.max_steps}" if trainer.max_steps > 0 else ""
        parts = [f"step {now[1]}{total}"]
        parts += [f"{name} {value:.4g}" for name, value in trainer.progress_bar_metrics.items()]
        if self._first is None:  # the first step compiles and fills caches: its time is not typical
            self._first = now
        else:
            parts.append(f"{(now[0] - self._last[0]) / (now[1] - self._last[1]):.3g} s a step")
            used = now[2] - self._first[2]
            if used > 0:
                parts.append(f"{clock((now[0] - self._first[0]) * (1 - now[2]) / used)} left")
        self._lines.say("  ".join(parts))
        self._last = now
