"""Callbacks: a progress bar, times and memory."""

import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any, ClassVar

import lightning.pytorch as L
import torch
from lightning.pytorch.callbacks import Callback, ProgressBar
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

from ghgs_lit.config.options import Options
from ghgs_lit.kernels.allocation import resident_bytes
from ghgs_lit.kernels.watching import Inputs, Watcher, watched
from ghgs_lit.runs.progress import Lines, clock, on_terminal
from ghgs_lit.training.cost import PARTS
from ghgs_lit.types import Batch


class ProgressOptions(Options):
    """A progress bar over the budget of the run."""

    def build(self) -> "RunProgress":
        return RunProgress()


class RunProgress(ProgressBar):
    """Progress of the run over its budget of steps or time. On a terminal a bar; elsewhere a line a minute.
    ``<run>/train.log`` gets the lines in both cases."""

    def __init__(self):
        super().__init__()
        self._bar: Progress | None = None
        self._lines: Lines | None = None

    def disable(self) -> None:
        """Called by Lightning in all processes except the first."""
        self._is_enabled = False

    def enable(self) -> None:
        self._is_enabled = True

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        if not getattr(self, "_is_enabled", True):
            return
        bar = on_terminal()
        self._lines = Lines(Path(trainer.default_root_dir) / "train.log", printed=not bar)
        self._first = None  # time, step and used budget of the first line, then of the last one
        self._last = (time.monotonic(), trainer.global_step, pl_module.used_budget)
        if not bar:
            return
        columns = BarColumn(), TaskProgressColumn(), TimeRemainingColumn()
        self._bar = Progress(TextColumn("training"), *columns, TextColumn("{task.fields[text]}"))
        self._bar.start()
        self._task = self._bar.add_task("training", total=1.0, text="")

    def on_train_batch_end(
        self, trainer: L.Trainer, pl_module: L.LightningModule, outputs: Any, batch: Batch, batch_idx: int
    ) -> None:
        if self._bar is not None:
            text = f"step {trainer.global_step}  {self._numbers(trainer, pl_module)}"
            self._bar.update(self._task, completed=pl_module.used_budget, text=text)
        # Nothing is new between two parts of an accumulated step.
        if self._lines is not None and trainer.global_step > self._last[1] and self._lines.due():
            self._say(trainer, pl_module)

    def _numbers(self, trainer: L.Trainer, pl_module: L.LightningModule) -> str:
        shown = {k: v for k, v in self.get_metrics(trainer, pl_module).items() if k != "v_num"}
        return "  ".join(f"{name} {value:.4g}" for name, value in shown.items())

    def _say(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        now = (time.monotonic(), trainer.global_step, pl_module.used_budget)
        total = f" of {trainer.max_steps}" if trainer.max_steps > 0 else ""
        parts = [f"step {now[1]}{total}", self._numbers(trainer, pl_module)]
        if self._first is None:  # the first step compiles and fills caches: its time is not typical
            self._first = now
        else:
            parts.append(f"{(now[0] - self._last[0]) / (now[1] - self._last[1]):.3g} s a step")
            used = now[2] - self._first[2]
            if used > 0:
                parts.append(f"{clock((now[0] - self._first[0]) * (1 - now[2]) / used)} left")
        self._lines.say("  ".join(parts))
        self._last = now

    def on_train_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        self._stop()

    def on_exception(
        self, trainer: L.Trainer, pl_module: L.LightningModule, exception: BaseException
    ) -> None:
        self._stop()

    def _stop(self) -> None:
        if self._bar is not None:
            self._bar.stop()
            self._bar = None


class CostsOptions(Options):
    """``time_ms/*``: milliseconds of each part of a step; ``memory_mb/*``: of the process and of the GPU."""

    def build(self) -> "Costs":
        return Costs()


class Costs(Callback, Watcher):
    """Logs milliseconds of a step and of its parts, and memory in MiB, each since the last log. Times are
    means; memory on CUDA is the peak of all tensors. ``time_ms/01_data`` is the wait for data,
    ``time_ms/step`` the sum of all parts. Validation and writing of checkpoints and logs do not count."""

    #: For each stage of the model: the part that ends where it begins, and the part that it is.
    STAGES: ClassVar = {
        "encoder": ("interval", "encode"),
        "depth_head": (None, "depth"),
        "recalibration": ("unproject", "recalibrate"),
        "gaussian_head": (None, "gaussians"),
        "rounds": (None, "rounds"),
    }

    def __init__(self):
        self._stack = ExitStack()

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        self._clock = pl_module.clock
        self._stack.enter_context(watched(pl_module.model, {name: name for name in self.STAGES}, self))
        self._clock.start(pl_module.device)

    def begin(self, stage: str, inputs: Inputs = ((), {})) -> None:
        if (before := self.STAGES[stage][0]) is not None:
            self._clock.mark(before)

    def end(self, stage: str, result: Any = None) -> None:
        self._clock.mark(self.STAGES[stage][1])

    def on_train_batch_start(self, trainer: L.Trainer, pl_module: L.LightningModule, *args: Any) -> None:
        pl_module.clock.mark("data")

    def on_after_backward(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        pl_module.clock.mark("backward")

    def on_train_batch_end(self, trainer: L.Trainer, pl_module: L.LightningModule, *args: Any) -> None:
        pl_module.clock.end_step()
        if trainer.global_step % trainer.log_every_n_steps == 0:
            names = {part: f"{number:02d}_{part}" for number, part in enumerate(PARTS, start=1)}
            means = pl_module.clock.means()
            pl_module.log_dict({f"time_ms/{names.get(part, part)}": ms for part, ms in means.items()})
            pl_module.log("memory_mb/process", resident_bytes() / 2**20)
            if pl_module.device.type == "cuda":
                peak = torch.cuda.max_memory_allocated(pl_module.device)
                pl_module.log("memory_mb/cuda_peak", peak / 2**20)
                torch.cuda.reset_peak_memory_stats(pl_module.device)

    def teardown(self, trainer: L.Trainer, pl_module: L.LightningModule, stage: str) -> None:
        pl_module.clock.stop()
        self._stack.close()
