"""Callbacks: progress of a run, its time and memory, and validation pictures."""

import datetime
import time
from pathlib import Path
from typing import Any

import lightning.pytorch as L
import numpy as np
import torch
from lightning.pytorch.callbacks import Callback, Timer
from lightning.pytorch.loggers import TensorBoardLogger

from ghgs_lit.config.options import Index, Options
from ghgs_lit.runtime.allocation import forget_peak, resident_bytes
from ghgs_lit.types import Batch
from ghgs_lit.visualization.pictures import save_png, sheet

EVERY = 60.0  #: Seconds between two progress lines


class ProgressOptions(Options):
    """Progress of the run over its budget of steps or time."""

    def build(self) -> "RunProgress":
        """Create the callback."""
        return RunProgress()


class RunProgress(Callback):
    """Progress of the run: one line a minute, also in ``<run>/train.log``."""

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Begin with a line after the first step."""
        self._log = Path(trainer.default_root_dir) / "train.log"
        self._next = time.monotonic()  # of the next line
        self._first = None  # time, step and used budget at the end of the first step
        self._written = trainer.global_step

    def on_train_batch_end(self, trainer: L.Trainer, pl_module: L.LightningModule, *args: Any) -> None:
        """Write a line if one is due."""
        step = trainer.global_step
        # Between two batches of an accumulated step nothing has changed.
        if trainer.is_global_zero and step > self._written and time.monotonic() >= self._next:
            text = self._text(trainer, pl_module.used_budget)  # reading values is a synchronisation
            line = f"{datetime.datetime.now():%H:%M:%S} {text}"
            print(line, flush=True)
            with open(self._log, "a") as file:
                file.write(line + "\n")
            self._next = time.monotonic() + EVERY
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
            remaining = seconds * (1 - used) / (used - self._first[2])
            parts.append(f"{datetime.timedelta(seconds=round(remaining))} left")
        return "  ".join(parts)


class TrainingCost(Callback):
    """Seconds and peak memory of the training, over all sessions of a run, with validations and writing
    of checkpoints.

    Checkpoints contain both, so that a resumed run continues to count. What a killed process did after
    its last checkpoint is repeated, and counts once.

    Has a timer instead of being one: Lightning ignores ``max_time`` if any callback is a Timer."""

    def __init__(self) -> None:
        self._timer = Timer()
        self._peak = 0  # bytes, of earlier sessions; of all sessions once training has ended

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Start the timer."""
        self._timer.on_train_start(trainer, pl_module)
        self._device = pl_module.device
        if self._device.type != "cuda":
            forget_peak()  # runs of a sweep share a process

    def on_train_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Stop the timer, and store the peak."""
        self._peak = self.peak_bytes
        self._timer.on_train_end(trainer, pl_module)

    @property
    def seconds(self) -> float:
        """Seconds of training in all sessions so far."""
        return self._timer.time_elapsed()

    @property
    def peak_bytes(self) -> int:
        """Peak memory in bytes of the first process over all sessions: of tensors on a GPU, or of the
        process on a CPU."""
        if self._timer.start_time() is None or self._timer.end_time() is not None:
            return self._peak
        on_gpu = self._device.type == "cuda"
        now = torch.cuda.max_memory_allocated(self._device) if on_gpu else resident_bytes("VmHWM")
        return max(self._peak, now)

    def state_dict(self) -> dict[str, Any]:
        """Seconds and peak memory so far, for the checkpoint."""
        return self._timer.state_dict() | {"peak_bytes": self.peak_bytes}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Continue from the numbers of a checkpoint."""
        self._timer.load_state_dict(state_dict)
        self._peak = state_dict["peak_bytes"]


class PicturesOptions(Options):
    """Pictures of the first subjects of each validation."""

    group = "callbacks.pictures"
    subjects: Index = 2
    """Number of subjects; 0: none."""

    def build(self) -> "Pictures":
        """Create the callback."""
        return Pictures(self)


class Pictures(Callback):
    """Logs ``view/sheet/<subject>``, inputs, depths, targets, renderings and errors, for each of the first
    validation subjects, and writes it to ``<run>/pictures``."""

    def __init__(self, options: PicturesOptions):
        self.options = options

    def on_validation_start(self, *args: Any) -> None:
        """Begin with the first subject."""
        self._number = 0

    def on_validation_batch_end(
        self,
        trainer: L.Trainer,
        pl_module: L.LightningModule,
        outputs: dict[str, Any],
        batch: Batch,
        *args: Any,
    ) -> None:
        """Log the subjects of a batch, up to the configured number.

        Args:
            outputs: result of :meth:`ghgs_lit.training.module.GHGSModule.validation_step`."""
        prediction = outputs["prediction"]
        image = outputs["rendering"].image
        count = min(self.options.subjects - self._number, len(batch.images))
        for element in range(count if trainer.is_global_zero else 0):
            name = batch.subjects[element] if batch.subjects else f"subject_{self._number}"
            _publish(trainer, name, sheet(batch, image, element, prediction.depth, prediction.depth_valid))
            self._number += 1


def _publish(trainer: L.Trainer, name: str, picture: np.ndarray) -> None:
    """Write a subject's picture [h, w, 3] uint8 to ``<run>/pictures/step_<step>/<name>.png``, and log it."""
    step = trainer.global_step
    save_png(picture, Path(trainer.default_root_dir) / "pictures" / f"step_{step:06d}" / f"{name}.png")
    for logger in trainer.loggers:
        if isinstance(logger, TensorBoardLogger):
            logger.experiment.add_image(f"view/sheet/{name}", picture, step, dataformats="HWC")
