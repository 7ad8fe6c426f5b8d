"""What training costs: seconds and memory, over all sessions of a run."""

import time
from typing import Any

import lightning.pytorch as L
import torch
from lightning.pytorch.callbacks import Callback

from ghgs_lit.kernels.allocation import forget_peak, resident_bytes


class TrainingCost(Callback):
    """Seconds and peak memory of the training that the weights have seen.

    Every checkpoint contains both, so that a resumed run goes on counting. What a killed process did after
    its last checkpoint is done again and counted once. Validation and the writing of checkpoints count.

    List it before callbacks that reset the peak of the GPU's memory.
    """

    def __init__(self) -> None:
        self._earlier = 0.0  # seconds of earlier sessions
        self._started: float | None = None
        self._peak = 0
        self._device = torch.device("cpu")

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        self._started, self._device = time.perf_counter(), pl_module.device
        if self._device.type != "cuda":
            forget_peak()  # the runs of a sweep share a process

    def on_train_batch_end(self, trainer: L.Trainer, pl_module: L.LightningModule, *args: Any) -> None:
        if self._device.type == "cuda":  # its peak may be reset at any step
            self._peak = self.peak_bytes

    def on_train_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        self._earlier, self._peak, self._started = self.seconds, self.peak_bytes, None

    @property
    def seconds(self) -> float:
        """Of all sessions so far."""
        return self._earlier + (0.0 if self._started is None else time.perf_counter() - self._started)

    @property
    def peak_bytes(self) -> int:
        """The highest memory of a session's first process: of all tensors on a GPU, else of the process."""
        if self._started is None:
            return self._peak
        on_gpu = self._device.type == "cuda"
        now = torch.cuda.max_memory_allocated(self._device) if on_gpu else resident_bytes("VmHWM")
        return max(self._peak, now)

    def state_dict(self) -> dict[str, Any]:
        return {"seconds": self.seconds, "peak_bytes": self.peak_bytes}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self._earlier, self._peak = state_dict["seconds"], state_dict["peak_bytes"]
