"""Watchers of a model's stages: observe their start and end, and their results.

The model contains no code for this: modules get forward hooks, other stages are wrapped while they are
watched.
"""

import time
from collections import defaultdict
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from typing import Any

import torch
from torch import nn

#: Point in time: seconds on the CPU, an event on CUDA.
Mark = float | torch.cuda.Event


class Watcher:
    """Base class with callbacks at the start and end of stages, including nested ones."""

    def begin(self, stage: str) -> None:
        """Called with the name of a stage when it begins."""

    def end(self, stage: str, result: Any = None) -> None:
        """Called with the name and the result of a stage when it ends."""


@contextmanager
def watch_stages(model: nn.Module, stages: Mapping[str, str], watcher: Watcher) -> Iterator[None]:
    """Call a watcher at every call of the stages while the context is active.

    Args:
        model: Model that contains the stages.
        stages: Dotted paths in ``model`` by the names passed to the watcher; stages that are None or
            missing are skipped.
        watcher: Watcher to call.
    """
    with ExitStack() as stack:
        for name, path in stages.items():
            parent, _, attribute = path.rpartition(".")
            owner = model.get_submodule(parent)
            stage = getattr(owner, attribute, None)
            if isinstance(stage, nn.Module):
                begin = stage.register_forward_pre_hook(lambda *_, name=name: watcher.begin(name))
                end = stage.register_forward_hook(lambda *given, name=name: watcher.end(name, given[-1]))
                stack.callback(begin.remove)
                stack.callback(end.remove)
            elif stage is not None:
                setattr(owner, attribute, Wrapped(stage, name, watcher))
                stack.callback(setattr, owner, attribute, stage)
        yield


@contextmanager
def watch_block(stage: str, watcher: Watcher) -> Iterator[None]:
    """Report the body of the context to ``watcher`` as a stage."""
    watcher.begin(stage)
    yield
    watcher.end(stage)


class Wrapped:
    """A watched stage that is not a module."""

    def __init__(self, stage: Any, name: str, watcher: Watcher):
        self._stage = stage
        self._name = name
        self._watcher = watcher

    def __call__(self, *arguments: Any, **options: Any) -> Any:
        self._watcher.begin(self._name)
        result = self._stage(*arguments, **options)
        self._watcher.end(self._name, result)
        return result

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stage, name)


class Stopwatch(Watcher):
    """Watcher that measures the total time of each stage on ``device``, with events on CUDA."""

    def __init__(self, device: torch.device):
        self.device = device
        self._open: list[Mark] = []
        self._spans: list[tuple[str, Mark, Mark]] = []

    def begin(self, stage: str) -> None:
        self._open.append(self._now())

    def end(self, stage: str, result: Any = None) -> None:
        self._spans.append((stage, self._open.pop(), self._now()))

    def _now(self) -> Mark:
        """Current time; on CUDA the time when all work submitted so far has finished."""
        if self.device.type != "cuda":
            return time.perf_counter()
        event = torch.cuda.Event(enable_timing=True)
        event.record(torch.cuda.current_stream(self.device))
        return event

    def seconds(self) -> dict[str, float]:
        """Seconds of each stage, in the order in which they first ended; synchronizes with the device."""
        is_cuda = self.device.type == "cuda"
        if is_cuda:
            torch.cuda.synchronize(self.device)
        total: dict[str, float] = defaultdict(float)
        for stage, begin, end in self._spans:
            total[stage] += begin.elapsed_time(end) / 1e3 if is_cuda else end - begin
        return dict(total)
