"""Cost of training: time of the parts of a step, and total time and peak memory of a run."""

from contextlib import ExitStack
from typing import Any

import lightning.pytorch as L
import torch
from lightning.pytorch.callbacks import Callback, Timer

from ghgs_lit.config.options import Options
from ghgs_lit.method.model import STAGES
from ghgs_lit.method.rounds import NoRounds
from ghgs_lit.runtime.allocation import forget_peak, resident_bytes
from ghgs_lit.runtime.watching import Stopwatch, watch_stages

#: Parts of a step, in order.
PARTS = ("data", *STAGES, "rounds", "render", "loss", "backward", "optimizer")
_PLACES = {name: f"model.{name}" for name in (*STAGES, "rounds")} | {"render": "renderer", "loss": "losses"}


class CostsOptions(Options):
    """``time_ms/*``: milliseconds of each part of a step;
    ``memory_mb/*``: of the process and of the GPU."""

    def build(self) -> "Costs":
        """Create the callback."""
        return Costs()


class Costs(Callback):
    """Logs the time of a step and of its parts in milliseconds, averaged since the last log, and memory
    in MiB, on CUDA the peak of all tensors.

    ``time_ms/01_data`` is the wait for data. Validations, other callbacks and writing of checkpoints
    and logs are not counted. Steps that are replayed as one CUDA graph
    (:mod:`ghgs_lit.execution.step`) have no stages; their ``time_ms/forward`` includes the gradients."""

    def __init__(self):
        self._stack = ExitStack()  # hooks of the present step

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Start a new stopwatch."""
        self._watch = Stopwatch(pl_module.device)
        self._steps = 0

    def on_train_batch_start(self, trainer: L.Trainer, pl_module: L.LightningModule, *args: Any) -> None:
        """Start timing the step, from the end of the last one, with the wait for data. Its stages are
        timed only if it is not captured, as their hooks would prevent a capture."""
        for part in ("step", "data"):
            self._watch.begin(part, since=pl_module.ready)
        self._watch.end("data")
        step = getattr(pl_module, "captured_step", None)
        self._is_captured = step is not None and step.may_capture(pl_module.device.type)
        if self._is_captured:
            self._watch.begin("forward")
        else:
            has_rounds = not isinstance(getattr(pl_module.model, "rounds", None), NoRounds)
            places = {part: place for part, place in _PLACES.items() if part != "rounds" or has_rounds}
            self._stack.enter_context(watch_stages(pl_module, places, self._watch))

    def on_before_backward(self, *args: Any) -> None:
        """Start timing the backward pass."""
        if self._is_captured:
            self._watch.end("forward")
        self._watch.begin("backward")

    def on_after_backward(self, *args: Any) -> None:
        """Stop timing the backward pass, and start with the optimizer."""
        self._watch.end("backward")
        self._watch.begin("optimizer")

    def on_train_batch_end(self, trainer: L.Trainer, pl_module: L.LightningModule, *args: Any) -> None:
        """Log the means since the last log, if a log is due."""
        self._watch.end("optimizer")
        self._watch.end("step")
        self._stack.close()
        self._steps += 1
        if trainer.global_step % trainer.log_every_n_steps:
            return
        names = {part: f"{number:02d}_{part}" for number, part in enumerate(PARTS, start=1)}
        for part, seconds in self._watch.seconds().items():
            pl_module.log(f"time_ms/{names.get(part, part)}", 1e3 * seconds / self._steps)
        pl_module.log("memory_mb/process", resident_bytes() / 2**20)
        if pl_module.device.type == "cuda":
            pl_module.log("memory_mb/cuda_peak", torch.cuda.max_memory_allocated(pl_module.device) / 2**20)
        self.on_train_start(trainer, pl_module)

    def on_exception(self, *args: Any) -> None:
        """Remove the hooks."""
        self._stack.close()


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
