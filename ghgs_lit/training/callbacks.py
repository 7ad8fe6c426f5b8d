"""Callbacks: progress of a run, neighbourhoods of the recalibration, exponential average of weights."""

import time
from contextlib import ExitStack
from pathlib import Path
from statistics import fmean
from typing import Annotated, Any

import lightning.pytorch as L
from lightning.pytorch.callbacks import Callback, WeightAveraging
from pydantic import Field
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn
from rich.table import Column
from torch.optim.swa_utils import get_ema_multi_avg_fn

from ghgs_lit.config.options import Options
from ghgs_lit.method.recalibration.inspection import collect_calls, neighborhoods
from ghgs_lit.runs.progress import Lines, format_duration, on_terminal


class ProgressOptions(Options):
    """Progress of the run over its budget of steps or time."""

    def build(self) -> "RunProgress":
        """Create the callback."""
        return RunProgress()


class RunProgress(Callback):
    """Progress of the run: a bar on a terminal, otherwise one line a minute.
    The lines are written to ``<run>/train.log`` in both cases."""

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Open the log and start the bar."""
        has_bar = on_terminal()
        self._lines = Lines(Path(trainer.default_root_dir) / "train.log", printed=not has_bar)
        text = TextColumn("{task.description}", table_column=Column())  # wraps on narrow terminals
        columns = (BarColumn(), TaskProgressColumn(), text)
        self._bar = Progress(*columns, disable=not (has_bar and trainer.is_global_zero))
        self._task = self._bar.add_task("training", total=1.0)
        self._bar.start()
        self._first = None  # time, step and used budget at the end of the first step
        self._written = trainer.global_step

    def on_train_batch_end(self, trainer: L.Trainer, pl_module: L.LightningModule, *args: Any) -> None:
        """Update the bar, and write a line if one is due."""
        step = trainer.global_step
        # Between two batches of an accumulated step nothing has changed.
        is_due = trainer.is_global_zero and step > self._written and self._lines.is_due()
        if is_due or not self._bar.disable:  # reading a step's values is a synchronisation
            text = self._text(trainer, pl_module.used_budget)
            self._bar.update(self._task, completed=pl_module.used_budget, description=text)
        if is_due:
            self._lines.write(text)
            self._written = step

    def _text(self, trainer: L.Trainer, used: float) -> str:
        """Step, logged values, steps per second and remaining time."""
        now, step = time.monotonic(), trainer.global_step
        total = f" of {trainer.max_steps}" if trainer.max_steps > 0 else ""
        values = trainer.progress_bar_metrics.items()
        parts = [f"step {step}{total}", *(f"{name} {value:.4g}" for name, value in values)]
        if self._first is None and step > self._written:  # slower: compiles and fills caches
            self._first = now, step, used
        elif self._first is not None and used > self._first[2]:
            seconds = now - self._first[0]
            parts.append(f"{(step - self._first[1]) / seconds:.3g} steps/s")
            parts.append(f"{format_duration(seconds * (1 - used) / (used - self._first[2]))} left")
        return "  ".join(parts)

    def on_train_end(self, *args: Any) -> None:
        """Stop the bar."""
        self._bar.stop()

    def on_exception(self, *args: Any) -> None:
        """Stop the bar, which restores the terminal."""
        if hasattr(self, "_bar"):  # training has started
            self._bar.stop()


class NeighborsAtStart(Callback):
    """Prints, for the first step, the number of tokens that take part in the recalibration, the number
    of their neighbours, and the share of these that the other value of
    ``recalibration.neighborhood`` has in common."""

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Start recording calls of the recalibration."""
        self._stack = ExitStack()
        stage = getattr(pl_module.model, "recalibration", None)
        self._seen = self._stack.enter_context(collect_calls(stage))

    def on_train_batch_end(self, trainer: L.Trainer, pl_module: L.LightningModule, *args: Any) -> None:
        """Print the numbers after the first step."""
        self._stack.close()
        if self._seen and trainer.is_global_zero:
            around = neighborhoods(*self._seen[-1])
            tokens = fmean(one.tokens for one in around)
            count = fmean(one.neighbors for one in around)
            shared = fmean(one.shared for one in around)
            other = "without" if pl_module.model.recalibration.neighborhood == "xyz" else "with"
            line = f"{tokens:.0f} tokens take part, {count:.0f} neighbours each, {shared:.0%} of them"
            print(f"recalibration: {line} the same {other} 3D unprojection", flush=True)
        self._seen = []

    def on_exception(self, *args: Any) -> None:
        """Stop recording calls."""
        if hasattr(self, "_stack"):
            self._stack.close()


class AveragingOptions(Options):
    """An exponential moving average (EMA) of all weights, those of a loss included. Validations measure
    it, checkpoints store it in addition to the trained weights, and it is the result of the run."""

    group = "callbacks.ema"
    decay: Annotated[float, Field(gt=0, lt=1)] = 0.999
    """Share of the average that each step keeps."""

    def build(self) -> "Averaging":
        """Create the callback."""
        return Averaging(self.decay)


class Averaging(WeightAveraging):
    """Lightning's exponential average of weights on the training device, updated for all weights of a
    dtype at once.

    Args:
        decay: share of the average, in (0, 1), that each step keeps."""

    def __init__(self, decay: float):
        super().__init__(multi_avg_fn=get_ema_multi_avg_fn(decay))

    def setup(self, trainer: L.Trainer, pl_module: L.LightningModule, stage: str) -> None:
        """Create the average on the training device."""
        self._device = trainer.strategy.root_device
        super().setup(trainer, pl_module, stage)
        if self._average_model is not None:  # a counter on a GPU would cost a synchronisation a step
            self._average_model.n_averaged = self._average_model.n_averaged.cpu()
