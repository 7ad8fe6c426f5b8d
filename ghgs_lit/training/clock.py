"""How long each part of a training step takes, on the CPU or on the device."""

from collections.abc import Sequence
from itertools import pairwise

import torch

from ghgs_lit.kernels.watching import Mark, seconds_between, time_mark

#: Parts of a step in their order.
PARTS = (
    "data",
    "interval",
    "encode",
    "depth",
    "unproject",
    "recalibrate",
    "gaussians",
    "rounds",
    "render",
    "loss",
    "backward",
    "optimizer",
)


class StepClock:
    """Measures the parts of a step: the time between two marks belongs to the part of the second.

    It does nothing before :meth:`start` and after :meth:`stop`. On CUDA the marks are events that are read
    when the next step ends, so that nothing waits for the device.
    """

    def __init__(self) -> None:
        self.device = torch.device("cpu")
        self.stop()

    def start(self, device: torch.device) -> None:
        """Begin to measure on ``device``, with the wait for the data of a step."""
        self.device, self.running = device, True
        self.restart()

    def stop(self) -> None:
        """Measure nothing from now on and forget everything."""
        self.running = False
        self._totals: dict[str, float] = {}
        self._steps = 0
        self._marks: list[tuple[str | None, Mark]] = []
        self._pending: list[tuple[str | None, Mark]] = []

    def restart(self) -> None:
        """Begin a step again here; marks since the last :meth:`end_step` are forgotten."""
        if self.running:
            self._marks = [(None, self._now())]

    def mark(self, part: str) -> None:
        """``part`` ends here."""
        if self.running:
            self._marks.append((part, self._now()))

    def end_step(self) -> None:
        """The step ends here, with its last part, the optimizer; the next one begins."""
        self.mark("optimizer")
        if self.device.type == "cuda":
            self._pending, self._marks = self._marks, self._pending
        self._add(self._marks)
        self.restart()

    def means(self) -> dict[str, float]:
        """Milliseconds of each part in a step since the last call, in order, and of the whole ``step``."""
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
