"""How long each part of a training step takes, on the CPU or on the device."""

import time
from collections.abc import Iterable
from dataclasses import dataclass, field
from itertools import pairwise

import torch

#: Parts of a step in their order.
PARTS = (
    "data",
    "interval",
    "encode",
    "depth",
    "unproject",
    "recalibrate",
    "gaussians",
    "render",
    "loss",
    "backward",
    "optimizer",
)


@dataclass
class StepClock:
    """Marks where each part of a step ends; what lies between two marks belongs to the second.

    On CUDA the marks are events, read when the next step ends: nothing waits for the device.
    """

    device: torch.device
    totals: dict[str, float] = field(default_factory=dict)
    steps: int = 0
    _marks: list[tuple[str | None, object]] = field(default_factory=list)
    _pending: list[tuple[str | None, object]] = field(default_factory=list)

    def start(self) -> None:
        """Begin to wait for the data of a step; marks since the last :meth:`end` are forgotten."""
        self._marks = [(None, self._now())]

    def mark(self, part: str) -> None:
        """``part`` ends here."""
        if self._marks:
            self._marks.append((part, self._now()))

    def end(self) -> None:
        """The step has ended, with its last part, the optimizer; the next one begins."""
        self.mark("optimizer")
        if self.device.type == "cuda":
            self._pending, self._marks = self._marks, self._pending
            self._add(self._marks)
        else:
            self._add(self._marks)
        self.start()

    def means(self) -> dict[str, float]:
        """Milliseconds of each part in a step since the last call, in order, and of the whole ``step``."""
        found = {part: 1e3 * self.totals[part] / self.steps for part in PARTS if part in self.totals}
        if found:
            found["step"] = sum(found.values())
        self.totals, self.steps = {}, 0
        return found

    def _add(self, marks: Iterable[tuple[str | None, object]]) -> None:
        marks = list(marks)
        if not marks:
            return
        self.steps += 1
        for (_, begin), (part, stop) in pairwise(marks):
            seconds = begin.elapsed_time(stop) / 1e3 if self.device.type == "cuda" else stop - begin
            self.totals[part] = self.totals.get(part, 0.0) + seconds

    def _now(self) -> object:
        if self.device.type != "cuda":
            return time.perf_counter()
        event = torch.cuda.Event(enable_timing=True)
        event.record()
        return event
