"""Watchers of a model's stages: observe their start and end, inputs and results.

The model contains no code for this: modules get forward hooks, other stages are wrapped while they are
watched.
"""

import time
from collections import defaultdict
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from operator import attrgetter
from typing import Any

import torch
from torch import nn

#: Point in time: seconds on the CPU, an event on CUDA.
Mark = float | torch.cuda.Event
#: Positional and named arguments of a stage.
Inputs = tuple[tuple, dict[str, Any]]


class Watcher:
    """Base class with callbacks at the start and end of stages, including nested ones."""

    def begin(self, stage: str, inputs: Inputs = ((), {})) -> Inputs | None:
        """Called when a stage begins.

        Args:
            stage: Name of the stage.
            inputs: Positional and keyword arguments.

        Returns:
            Inputs that replace the original ones; None: keep them.
        """

    def end(self, stage: str, result: Any = None) -> None:
        """Called when a stage ends.

        Args:
            stage: Name of the stage.
            result: Return value of the stage.
        """


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
            owner = attrgetter(parent)(model) if parent else model
            stage = getattr(owner, attribute, None)
            if isinstance(stage, nn.Module):
                for hook in _hooks(stage, name, watcher):
                    stack.callback(hook.remove)
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


def _hooks(stage: nn.Module, name: str, watcher: Watcher) -> tuple:
    return (
        stage.register_forward_pre_hook(lambda _, *inputs: watcher.begin(name, inputs), with_kwargs=True),
        stage.register_forward_hook(lambda _, __, result: watcher.end(name, result)),
    )


class Wrapped:
    """A watched stage that is not a module."""

    def __init__(self, stage: Any, name: str, watcher: Watcher):
        self._stage = stage
        self._name = name
        self._watcher = watcher

    def __call__(self, *arguments: Any, **options: Any) -> Any:
        inputs = (arguments, options)
        arguments, options = self._watcher.begin(self._name, inputs) or inputs
        result = self._stage(*arguments, **options)
        self._watcher.end(self._name, result)
        return result

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stage, name)


def time_mark(device: torch.device) -> Mark:
    """Current time on ``device``; on CUDA the time when all work submitted so far has finished."""
    if device.type != "cuda":
        return time.perf_counter()
    event = torch.cuda.Event(enable_timing=True)
    event.record(torch.cuda.current_stream(device))
    return event


def seconds_between(begin: Mark, end: Mark) -> float:
    """Seconds between two marks of :func:`time_mark` on the same device; both must have been reached."""
    return end - begin if isinstance(begin, float) else begin.elapsed_time(end) / 1e3


class Stopwatch(Watcher):
    """Watcher that measures the total time of each stage on ``device``, with events on CUDA."""

    def __init__(self, device: torch.device):
        self.device = device
        self._open: list[Mark] = []
        self._spans: list[tuple[str, Mark, Mark]] = []

    def begin(self, stage: str, inputs: Inputs = ((), {})) -> None:
        self._open.append(time_mark(self.device))

    def end(self, stage: str, result: Any = None) -> None:
        self._spans.append((stage, self._open.pop(), time_mark(self.device)))

    def seconds(self) -> dict[str, float]:
        """Seconds of each stage, in the order in which they first ended; synchronizes with the device."""
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)
        total: dict[str, float] = defaultdict(float)
        for stage, begin, stop in self._spans:
            total[stage] += seconds_between(begin, stop)
        return dict(total)
