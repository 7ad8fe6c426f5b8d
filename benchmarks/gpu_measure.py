"""Measurement for ``benchmarks/gpu.py``: times, launches and synchronisations of a GPU.

Also a rehearsal without a GPU, and the arguments of a section: device, sizes, and the file of
results.
"""

import contextlib
import itertools
import json
import statistics
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest import mock

import torch
from torch.profiler import ProfilerActivity, profile

from benchmarks.device import render_nothing
from ghgs_lit.config import run_of
from ghgs_lit.config.run import Run
from ghgs_lit.diagnostics.benchmark.scene import ellipsoid_batch
from ghgs_lit.execution import predictor, step
from ghgs_lit.execution.capture import CudaGraphs
from ghgs_lit.geometry import precision
from ghgs_lit.types import Batch
from tests.helpers.capture_backends import OperatorBackend
from tests.helpers.pretend_device import DEVICE, pretend_device

#: Categories of trace events that count as GPU work; in a rehearsal, operators.
WORK, REHEARSED_WORK = ("kernel", "gpu_memcpy", "gpu_memset"), ("cpu_op",)
LONGEST = 40  #: number of listed kernels


class Gpu:
    """A measured GPU; ``is_real``: not the pretend device of a rehearsal."""

    def __init__(self, device: torch.device, is_real: bool):
        self.device, self.is_real = device, is_real

    def backend(self) -> CudaGraphs | OperatorBackend:
        """Capture backend: CUDA graphs; in a rehearsal, a stand-in that repeats operators."""
        return CudaGraphs() if self.is_real else OperatorBackend(self.device.type)

    def milliseconds(self, call: Callable[[], Any], repeats: int) -> float:
        """Median time of a call between events; it includes idle time if the host submits too slowly."""
        for _ in range(min(repeats, 3)):
            call()  # compilation and caches
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
        """Median times of consecutive calls, by events between them."""
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
        """Profile a call.

        Returns:
            Means over ``repeats``: ``busy_ms`` of the GPU, ``launches``, ``waits`` (synchronisations
            of the host), and ``longest``, the kernels with the largest total times: name, calls,
            milliseconds.
        """
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
            "waits": max(waits - 1, 0) / repeats,  # the last one is of this function
            "longest": longest,
        }


def _events(found: profile) -> list[dict]:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "trace.json"
        found.export_chrome_trace(str(path))
        return [event for event in json.loads(path.read_text())["traceEvents"] if "dur" in event]


def reason(error: BaseException) -> str:
    """Format an error in one line, with the innermost line of the package in its traceback."""
    lines = [f for f in traceback.extract_tb(error.__traceback__) if "ghgs_lit" in f.filename]
    place = f" ({Path(lines[-1].filename).name}:{lines[-1].lineno})" if lines else ""
    return f"{type(error).__name__}: {' '.join(str(error).split())[:200]}{place}"


@contextlib.contextmanager
def rehearsal() -> Iterator[Gpu]:
    """The pretend device of the tests as a GPU, with stand-ins for CUDA-only parts of PyTorch."""
    with pretend_device(), render_nothing(), contextlib.ExitStack() as stack:
        for name, value in _stand_ins().items():
            stack.enter_context(mock.patch.object(torch.cuda, name, value))
        stack.enter_context(mock.patch.object(torch, "compile", lambda function, **_: function))
        stack.enter_context(mock.patch.object(precision, "has_bfloat16", return_value=True))
        on_cuda = partial(precision.precision_of, device=torch.device("cuda"))  # tf32, too
        for module in (predictor, step):
            stack.enter_context(mock.patch.object(module, "precision_of", lambda name, _: on_cuda(name)))
        without = partial(torch.autocast, enabled=False)  # the CPU stand-in has no half precision
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


@dataclass(frozen=True)
class Sizes:
    """Sizes and repetitions of the measurements."""

    side: int = 252
    large: int = 518
    views: int = 4
    batches: tuple[int, ...] = (1, 8)
    large_batches: tuple[int, ...] = (1, 2)
    encoder: str = "vggt_1b"
    shipped: tuple[str, ...] = ()  #: further overrides of experiment=shipped
    repeats: int = 15
    copied: int = 2**28  #: numbers of float32
    product: int = 8192  #: rows and columns
    vertices: int = 10475
    workers: tuple[int, ...] = (4, 8, 15)
    seconds: float = 8.0  #: per measurement of the loader
    people: tuple[tuple[int, int, int], ...] = (
        *((16, 8, 4), (48, 24, 16), (96, 48, 16), (144, 72, 16), (200, 100, 16)),
    )  #: training people, active ones, validation people, rendered step by step
    training: tuple[str, ...] = ("trainer.max_time=00:00:03:00", "trainer.val_check_interval=25")


DRY = Sizes(
    side=56,
    large=56,
    views=2,
    batches=(1, 2),
    encoder="vggt_nano",
    shipped=(
        *("data.size=28", "data.render.samples=1", "encoder.width=48", "augmentation=none"),
        "rounds.height=null",  # downsampled views would prevent the capture of steps
    ),
    repeats=1,
    copied=2**10,
    product=64,
    vertices=50,
    workers=(0,),
    seconds=0.1,
    people=((2, 1, 1),),
    training=("trainer=cpu", "trainer.max_steps=4", "trainer.val_check_interval=2", "views=v3"),
)


class Rows:
    """A file of results, a line of JSON each, which keeps earlier results if the process is killed."""

    def __init__(self, file: Path):
        self.file = file

    def add(self, **values: Any) -> None:
        """Append a line immediately."""
        with self.file.open("a") as lines:
            lines.write(json.dumps(values) + "\n")

    def read(self) -> list[dict[str, Any]]:
        """Read all lines so far."""
        lines = self.file.read_text().splitlines() if self.file.exists() else []
        return [json.loads(line) for line in lines]


@dataclass(frozen=True)
class Call:
    """Arguments of a section."""

    gpu: Gpu
    rows: "Rows"
    section: str
    sizes: Sizes
    work: Path
    overrides: list[str] = field(default_factory=list)

    def add(self, row: str, **numbers: Any) -> None:
        """Append a row immediately."""
        self.rows.add(section=self.section, row=row, **numbers)

    @property
    def rendered(self) -> list[int]:
        """Numbers of rendered people: in training, active ones, in validation."""
        return [row["numbers"] for row in self.rows.read() if "numbers" in row][-1]

    def run(self, *overrides: str) -> Run:
        return run_of("train", list(overrides))

    @property
    def shipped(self) -> list[str]:
        """Overrides of the training of the shipped weights."""
        return ["experiment=shipped", *self.sizes.shipped]

    def batch(self, size: int, side: int) -> Batch:
        """``size`` subjects that cover 15 % of the frame, on the CPU, with depths and bodies."""
        batch = ellipsoid_batch(0.15, self.sizes.views, side, size)
        vertices = [torch.rand(self.sizes.vertices, 3) for _ in range(size)]
        batch = replace(batch, depths=2.0 * batch.masks, body_vertices=vertices)
        return batch.pin_memory() if self.gpu.is_real else batch
