"""Cost of training: time of the parts of a step, and time and memory over all sessions of a run."""

import time
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import lightning.pytorch as L
import torch
from lightning.pytorch.callbacks import Callback

from ghgs_lit.kernels.allocation import forget_peak, resident_bytes
from ghgs_lit.kernels.watching import Mark, seconds_between, time_mark

#: Parts of a step in their order.
PARTS = (
    "data", "interval", "encode", "depth", "unproject", "recalibrate", "gaussians", "rounds", "render",
    "loss", "backward", "optimizer",
)  # fmt: skip


class StepClock:
    """Measures the parts of a step: the time between two marks belongs to the part of the second. It does
    nothing before :meth:`start` and after :meth:`stop`. On CUDA marks are events, read at the end of the next
    step, so that nothing waits for the device."""

    def __init__(self) -> None:
        self.device = torch.device("cpu")
        self.stop()

    def start(self, device: torch.device) -> None:
        """Begin to measure on ``device``; the first part is the wait for data."""
        self.device, self.running = device, True
        self.restart()

    def stop(self) -> None:
        """Stop measuring, and discard all measurements."""
        self.running = False
        self._totals: dict[str, float] = {}
        self._steps = 0
        self._marks: list[tuple[str | None, Mark]] = []
        self._pending: list[tuple[str | None, Mark]] = []

    def restart(self) -> None:
        """Begin the step here; marks since the last :meth:`end_step` are discarded."""
        if self.running:
            self._marks = [(None, self._now())]

    def mark(self, part: str) -> None:
        """``part`` ends here."""
        if self.running:
            self._marks.append((part, self._now()))

    def end_step(self) -> None:
        """The step ends here with its last part, the optimizer; the next one begins."""
        self.mark("optimizer")
        if self.device.type == "cuda":
            self._pending, self._marks = self._marks, self._pending
        self._add(self._marks)
        self.restart()

    def means(self) -> dict[str, float]:
        """Mean milliseconds of each part of a step since the last call, in order, and of the ``step``."""
        found = {part: 1e3 * self._totals[part] / self._steps for part in PARTS if part in self._totals}
        if found:
            found["step"] = sum(found.values())
        self._totals, self._steps = {}, 0
        return found

    def _add(self, marks: Sequence[tuple[str | None, Mark]]) -> None:
        self._steps += bool(marks)
        for (_, begin), (part, stop) in pairwise(marks):
            self._totals[part] = self._totals.get(part, 0.0) + seconds_between(begin, stop)

    def _now(self) -> Mark:
        return time_mark(self.device)


class TrainingCost(Callback):
    """Seconds and peak memory of the training of the weights. Checkpoints contain both, so that a resumed run
    continues to count; work after the last checkpoint of a killed process is repeated and counts once.
    Validation and writing of checkpoints count. List it before callbacks that reset the GPU's peak."""

    def __init__(self) -> None:
        self._earlier = 0.0  # seconds of earlier sessions
        self._started: float | None = None
        self._peak = 0
        self._device = torch.device("cpu")

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        self._started, self._device = time.perf_counter(), pl_module.device
        if self._device.type != "cuda":
            forget_peak()  # runs of a sweep share a process

    def on_train_batch_end(self, trainer: L.Trainer, pl_module: L.LightningModule, *args: Any) -> None:
        if self._device.type == "cuda":  # its peak may be reset at any step
            self._peak = self.peak_bytes

    def on_train_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        self._earlier, self._peak, self._started = self.seconds, self.peak_bytes, None

    @property
    def seconds(self) -> float:
        """Seconds of all sessions so far."""
        return self._earlier + (0.0 if self._started is None else time.perf_counter() - self._started)

    @property
    def peak_bytes(self) -> int:
        """Peak memory of the first process over all sessions: of tensors on a GPU, else of the process."""
        if self._started is None:
            return self._peak
        on_gpu = self._device.type == "cuda"
        now = torch.cuda.max_memory_allocated(self._device) if on_gpu else resident_bytes("VmHWM")
        return max(self._peak, now)

    def state_dict(self) -> dict[str, Any]:
        return {"seconds": self.seconds, "peak_bytes": self.peak_bytes}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self._earlier, self._peak = state_dict["seconds"], state_dict["peak_bytes"]
