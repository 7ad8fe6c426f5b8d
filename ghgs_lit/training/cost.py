"""Cost of training: time of the parts of a step, and time and memory over all sessions of a run."""

import time
from contextlib import ExitStack
from typing import Any

import lightning.pytorch as L
import torch
from lightning.pytorch.callbacks import Callback

from ghgs_lit.config.options import Options
from ghgs_lit.method.model import STAGES
from ghgs_lit.method.rounds import NoRounds
from ghgs_lit.runtime.allocation import forget_peak, resident_bytes
from ghgs_lit.runtime.watching import Inputs, Stopwatch, Watcher, watched

#: Parts of a step in their order.
PARTS = ("data", *STAGES, "rounds", "render", "loss", "backward", "optimizer")


class CostsOptions(Options):
    """``time_ms/*``: milliseconds of each part of a step;
    ``memory_mb/*``: of the process and of the GPU."""

    def build(self) -> "Costs":
        """The callback."""
        return Costs()


class Costs(Callback, Watcher):
    """Logs milliseconds of a step and of its parts, means since the last log, and memory in MiB, on
    CUDA the peak of all tensors since the last log. ``time_ms/01_data`` is the wait for data.
    Validation, other callbacks and writing of checkpoints and logs do not count. Steps that are
    replayed as one CUDA graph (:mod:`ghgs_lit.execution.step`) have no stages:
    ``time_ms/forward`` is loss and gradients."""

    def __init__(self):
        self._stack = ExitStack()
        self._inside = False  # a step, not a validation
        self._has_stages = True

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Watch all stages, unless this would keep steps from being captured."""
        self._begin_interval(pl_module)
        step = getattr(pl_module, "captured_step", None)
        self._has_stages = step is None or not step.may_capture(pl_module.device.type)
        if not self._has_stages:
            return
        places = {name: f"model.{name}" for name in (*STAGES, "rounds")}
        if isinstance(getattr(pl_module.model, "rounds", None), NoRounds):
            del places["rounds"]
        places |= {"render": "renderer", "loss": "losses"}
        self._stack.enter_context(watched(pl_module, places, self))

    def _begin_interval(self, pl_module: L.LightningModule) -> None:
        """Measure anew."""
        self._watch = Stopwatch(pl_module.device)
        self._steps = 0

    def begin(self, stage: str, inputs: Inputs = ((), {})) -> None:
        """A part of a step begins.

        Args:
            stage: its name, one of :data:`PARTS`.
            inputs: not used."""
        if self._inside:
            self._watch.begin(stage)

    def end(self, stage: str, result: Any = None) -> None:
        """A part of a step ends.

        Args:
            stage: its name.
            result: not used."""
        if self._inside:
            self._watch.end(stage)

    def on_train_batch_start(self, trainer: L.Trainer, pl_module: L.LightningModule, *args: Any) -> None:
        """A step began where the last one ended, with the wait for data."""
        self._inside = True
        for stage in ("step", "data"):
            self._watch.begin(stage, since=pl_module.ready)
        self.end("data")
        if not self._has_stages:
            self.begin("forward")

    def on_before_backward(self, *args: Any) -> None:
        """The backward pass begins."""
        if not self._has_stages:
            self.end("forward")
        self.begin("backward")

    def on_after_backward(self, *args: Any) -> None:
        """The backward pass ends."""
        self.end("backward")
        self.begin("optimizer")

    def on_train_batch_end(self, trainer: L.Trainer, pl_module: L.LightningModule, *args: Any) -> None:
        """Log the means since the last log, if it is due."""
        self.end("optimizer")
        self.end("step")
        self._inside = False
        self._steps += 1
        if trainer.global_step % trainer.log_every_n_steps == 0:
            means = {part: 1e3 * s / self._steps for part, s in self._watch.seconds().items()}
            names = {part: f"{number:02d}_{part}" for number, part in enumerate(PARTS, start=1)}
            pl_module.log_dict({f"time_ms/{names.get(part, part)}": ms for part, ms in means.items()})
            self._begin_interval(pl_module)
            pl_module.log("memory_mb/process", resident_bytes() / 2**20)
            if pl_module.device.type == "cuda":
                peak = torch.cuda.max_memory_allocated(pl_module.device)
                pl_module.log("memory_mb/cuda_peak", peak / 2**20)
                torch.cuda.reset_peak_memory_stats(pl_module.device)

    def teardown(self, trainer: L.Trainer, pl_module: L.LightningModule, stage: str) -> None:
        """Watch no longer."""
        self._stack.close()


class TrainingCost(Callback):
    """Seconds and peak memory of the training of the weights. Checkpoints contain both, so that a
    resumed run continues to count; work after the last checkpoint of a killed process is repeated
    and counts once. Validation and writing of checkpoints count. List it before callbacks that
    reset the GPU's peak."""

    def __init__(self) -> None:
        self._earlier = 0.0  # seconds of earlier sessions
        self._started: float | None = None
        self._peak = 0
        self._device = torch.device("cpu")

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Start the clock."""
        self._started = time.perf_counter()
        self._device = pl_module.device
        if self._device.type != "cuda":
            forget_peak()  # runs of a sweep share a process

    def on_train_batch_end(self, trainer: L.Trainer, pl_module: L.LightningModule, *args: Any) -> None:
        """Note the peak of memory."""
        if self._device.type == "cuda":  # its peak may be reset at any step
            self._peak = self.peak_bytes

    def on_train_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Stop the clock."""
        self._earlier = self.seconds
        self._peak = self.peak_bytes
        self._started = None

    @property
    def seconds(self) -> float:
        """Seconds of all sessions so far."""
        return self._earlier + (0.0 if self._started is None else time.perf_counter() - self._started)

    @property
    def peak_bytes(self) -> int:
        """Peak memory of the first process over all sessions: of tensors on a GPU,
        else of the process."""
        if self._started is None:
            return self._peak
        on_gpu = self._device.type == "cuda"
        now = torch.cuda.max_memory_allocated(self._device) if on_gpu else resident_bytes("VmHWM")
        return max(self._peak, now)

    def state_dict(self) -> dict[str, Any]:
        """Seconds and peak so far, for the checkpoint."""
        return {"seconds": self.seconds, "peak_bytes": self.peak_bytes}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Go on from the numbers of a checkpoint."""
        self._earlier = state_dict["seconds"]
        self._peak = state_dict["peak_bytes"]
