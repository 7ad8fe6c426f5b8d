"""Time and peak memory of the stages of a computation, from Linux's own counters."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from ghgs_lit.runtime.allocation import forget_peak, resident_bytes, return_free_memory


@dataclass
class Stage:
    """Time, memory and work of one stage; GB are in addition to what the process held before
    all stages."""

    name: str
    seconds: float
    before_gb: float
    peak_gb: float
    gflop: float = 0.0


def merged(name: str, stages: list[Stage]) -> Stage:
    """Consecutive stages as one."""
    seconds, gflop = (sum(getattr(stage, field) for stage in stages) for field in ("seconds", "gflop"))
    return Stage(name, seconds, stages[0].before_gb, max(stage.peak_gb for stage in stages), gflop)


def memory_gb(field: str) -> float:
    """``VmRSS`` (memory now) or ``VmHWM`` (peak since the last reset) of this process."""
    return resident_bytes(field) / 1e9


class Recorder:
    """Times stages and reads their peak memory;
    ``base`` is what the process holds at construction."""

    def __init__(self) -> None:
        return_free_memory()
        self.base = memory_gb("VmRSS")
        self.stages: list[Stage] = []

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        return_free_memory()
        before = memory_gb("VmRSS") - self.base
        forget_peak()
        start = time.perf_counter()
        yield
        seconds = time.perf_counter() - start
        self.stages.append(Stage(name, seconds, before, memory_gb("VmHWM") - self.base))
