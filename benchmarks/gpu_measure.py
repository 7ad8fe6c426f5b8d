"""How long a GPU is busy, with what, and what it is waited for; a rehearsal of that without a GPU."""

import contextlib
import itertools
import json
import statistics
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest import mock

import torch
from torch.profiler import ProfilerActivity, profile

from benchmarks.device import drawing_nothing
from ghgs_lit.execution import predictor, step
from ghgs_lit.execution.capture import CaptureBackend, CudaGraphs
from ghgs_lit.geometry import precision
from tests.helpers.capture_backends import OperatorBackend
from tests.helpers.pretend_device import DEVICE, pretend_device

#: Kinds of a trace's events that are work of a GPU; in a rehearsal, operators.
WORK, REHEARSED_WORK = ("kernel", "gpu_memcpy", "gpu_memset"), ("cpu_op",)
LONGEST = 40  #: Kernels that are listed


class Gpu:
    """A GPU that is measured; ``is_real``: not the pretend device of a rehearsal."""

    def __init__(self, device: torch.device, is_real: bool):
        self.device, self.is_real = device, is_real

    def backend(self) -> CaptureBackend:
        """What records: CUDA graphs; in a rehearsal a stand-in that repeats operators."""
        return CudaGraphs() if self.is_real else OperatorBackend(self.device.type)

    def milliseconds(self, call: Callable[[], Any], repeats: int) -> float:
        """Median time of a call, by events; the host submits as fast as it can."""
        for _ in range(min(repeats, 3)):
            call()  # compiles, fills caches
        spans = []
        for _ in range(repeats):
            begin, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
            torch.cuda.synchronize()
            begin.record()
            call()
            end.record()
            torch.cuda.synchronize()
            spans.append(begin.elapsed_time(end))
        return statistics.median(spans)

    def milliseconds_of_each(self, calls: Sequence[Callable[[], Any]], repeats: int) -> list[float]:
        """Median times of calls that follow one another, by events between them."""
        spans: list[list[float]] = [[] for _ in calls]
        for _ in range(repeats):
            marks = [torch.cuda.Event(enable_timing=True) for _ in range(len(calls) + 1)]
            torch.cuda.synchronize()
            marks[0].record()
            for call, mark in zip(calls, marks[1:], strict=True):
                call()
                mark.record()
            torch.cuda.synchronize()
            for span, (begin, end) in zip(spans, itertools.pairwise(marks), strict=True):
                span.append(begin.elapsed_time(end))
        return [statistics.median(span) for span in spans]

    def work(self, call: Callable[[], Any], repeats: int = 3) -> dict[str, Any]:
        """Of a call, means: ``busy_ms`` of the GPU, ``launches``, ``waits`` of the host, and
        ``longest``, the kernels that take most of the time: name, calls, milliseconds."""
        torch.cuda.synchronize()
        with profile(activities=[ProfilerActivity.CPU, ProfilerActivity.CUDA]) as found:
            for _ in range(repeats):
                call()
            torch.cuda.synchronize()
        events = _events(found)
        kinds = WORK if self.is_real else REHEARSED_WORK
        times, calls = Counter(), Counter()
        for event in events:
            if event.get("cat") in kinds:
                times[event["name"]] += event["dur"] / 1e3 / repeats
                calls[event["name"]] += 1
        waits = sum("Synchronize" in event["name"] for event in events if event.get("cat") == "cuda_runtime")
        longest = [(name[:120], calls[name] / repeats, ms) for name, ms in times.most_common(LONGEST)]
        return {
            "busy_ms": sum(times.values()),
            "launches": calls.total() / repeats,
            "waits": max(waits - 1, 0) / repeats,  # the last one is this function's
            "longest": longest,
        }


def _events(found: profile) -> list[dict]:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "trace.json"
        found.export_chrome_trace(str(path))
        return [event for event in json.loads(path.read_text())["traceEvents"] if "dur" in event]


def reason(error: BaseException) -> str:
    """An error in one line, with the innermost line of the package that led to it."""
    lines = [f for f in traceback.extract_tb(error.__traceback__) if "ghgs_lit" in f.filename]
    place = f" ({Path(lines[-1].filename).name}:{lines[-1].lineno})" if lines else ""
    return f"{type(error).__name__}: {' '.join(str(error).split())[:200]}{place}"


@contextlib.contextmanager
def rehearsal() -> Iterator[Gpu]:
    """The pretend device of the tests as a GPU,
    with stand-ins for what PyTorch has for CUDA alone."""
    with pretend_device(), drawing_nothing(), contextlib.ExitStack() as stack:
        for name, value in _stand_ins().items():
            stack.enter_context(mock.patch.object(torch.cuda, name, value))
        stack.enter_context(mock.patch.object(torch, "compile", lambda function, **_: function))
        stack.enter_context(mock.patch.object(precision, "has_bfloat16", return_value=True))
        on_cuda = partial(precision.precision_of, device=torch.device("cuda"))  # tf32, too
        for module in (predictor, step):
            stack.enter_context(mock.patch.object(module, "precision_of", lambda name, _: on_cuda(name)))
        without = partial(torch.autocast, enabled=False)  # it has no half precision
        stack.enter_context(mock.patch.object(torch, "autocast", lambda device, *_, **__: without(device)))
        yield Gpu(DEVICE, is_real=False)


class _Event:
    def __init__(self, **_):
        self.time = 0.0

    def record(self) -> None:
        self.time = time.perf_counter()

    def elapsed_time(self, end: "_Event") -> float:
        return 1e3 * (end.time - self.time)


def _stand_ins() -> dict[str, Any]:
    return {
        "Event": _Event,
        "empty_cache": lambda: None,
        "get_device_properties": lambda device: SimpleNamespace(name="pretend", total_memory=80 << 30),
        "max_memory_allocated": lambda device=None: 0,
        "reset_peak_memory_stats": lambda device=None: None,
        "set_per_process_memory_fraction": lambda share, device=None: None,
        "synchronize": lambda device=None: None,
    }
