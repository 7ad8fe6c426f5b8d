"""Peak memory of stages: of the process on a CPU (Linux's own counters), of all tensors on CUDA."""

from typing import Any

import torch

from ghgs_lit.kernels.allocation import can_forget_peak, forget_peak, resident_bytes, return_free_memory
from ghgs_lit.kernels.watching import Inputs, Watcher


class PeakProbe(Watcher):
    """The peak memory of each stage.

    ``peaks`` are bytes in addition to what was held when the first stage began: weights and photographs do
    not count. Stages may lie inside one another. On systems without Linux's counters there are no peaks.
    """

    def __init__(self, device: torch.device):
        self.device = device
        self.peaks: dict[str, int] = {}
        self._open: list[str] = []
        self._base = 0

    def begin(self, stage: str, inputs: Inputs = ((), {})) -> None:
        if self.is_available:
            if self._open:
                self._note()
            else:
                self._base = self.held()
            self.reset()
            self._open.append(stage)

    def end(self, stage: str, result: Any = None) -> None:
        if self.is_available:
            self._note()
            self._open.pop()
            self.reset()

    def _note(self) -> None:
        peak = self.peak() - self._base
        for stage in self._open:
            self.peaks[stage] = max(self.peaks.get(stage, 0), peak)

    @property
    def is_available(self) -> bool:
        """Whether the system has counters whose peak can be reset."""
        return self.device.type == "cuda" or can_forget_peak()

    def held(self) -> int:
        """Bytes now."""
        if self.device.type == "cuda":
            return torch.cuda.memory_allocated(self.device)
        return_free_memory()
        return resident_bytes()

    def peak(self) -> int:
        """Most bytes since the last :meth:`reset`."""
        is_cuda = self.device.type == "cuda"
        return torch.cuda.max_memory_allocated(self.device) if is_cuda else resident_bytes("VmHWM")

    def reset(self) -> None:
        """Forget the peak."""
        if self.device.type == "cuda":
            torch.cuda.reset_peak_memory_stats(self.device)
        else:
            return_free_memory()  # what an earlier stage freed is not this one's
            forget_peak()
