"""Watching the stages of a model from outside: when each begins and ends, what it takes and what it gives.

The model knows nothing of this: stages that are modules get hooks, others are wrapped while somebody watches.
"""

import time
from collections import defaultdict
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from operator import attrgetter
from typing import Any

import torch
from torch import nn

#: A moment: seconds on the CPU, an event on CUDA.
Mark = float | torch.cuda.Event
#: What a stage is called with: positional and named arguments.
Inputs = tuple[tuple, dict[str, Any]]


class Watcher:
    """What sees stages begin and end, one inside the other; subclasses override what they need."""

    def begin(self, stage: str, inputs: Inputs = ((), {})) -> Inputs | None:
        """``stage`` begins; inputs that are returned take the place of its own."""

    def end(self, stage: str, result: Any = None) -> None:
        """``stage`` ends and gives ``result``."""


@contextmanager
def watched(model: nn.Module, stages: Mapping[str, str], watcher: Watcher) -> Iterator[None]:
    """Let ``watcher`` see the calls of stages while the context lasts. ``stages``: dotted paths of the stages
    in ``model`` by the name that ``watcher`` is told; a stage that is None or missing is left out."""
    with ExitStack() as stack:
        for name, path in stages.items():
            parent, _, attribute = path.rpartition(".")
            owner = attrgetter(parent)(model) if parent else model
            stage = getattr(owner, attribute, None)
            if isinstance(stage, nn.Module):
                for hook in _hooks(stage, name, watcher):
                    stack.callback(hook.remove)
            elif stage is not None:
                setattr(owner, attribute, _Wrapped(stage, name, watcher))
                stack.callback(setattr, owner, attribute, stage)
        yield


@contextmanager
def inside(stage: str, watcher: Watcher) -> Iterator[None]:
    """Let ``watcher`` see a stage that lasts as long as the context."""
    watcher.begin(stage)
    yield
    watcher.end(stage)


def _hooks(stage: nn.Module, name: str, watcher: Watcher) -> tuple:
    return (
        stage.register_forward_pre_hook(lambda _, *inputs: watcher.begin(name, inputs), with_kwargs=True),
        stage.register_forward_hook(lambda _, __, result: watcher.end(name, result)),
    )


class _Wrapped:
    """A stage that is no module, with a watcher of each call; all else is the stage's own."""

    def __init__(self, stage: Any, name: str, watcher: Watcher):
        self._stage, self._name, self._watcher = stage, name, watcher

    def __call__(self, *arguments: Any, **options: Any) -> Any:
        inputs = (arguments, options)
        arguments, options = self._watcher.begin(self._name, inputs) or inputs
        result = self._stage(*arguments, **options)
        self._watcher.end(self._name, result)
        return result

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stage, name)


def time_mark(device: torch.device) -> Mark:
    """This moment on ``device``: on CUDA, when the work that was given to it so far is done."""
    if device.type != "cuda":
        return time.perf_counter()
    event = torch.cuda.Event(enable_timing=True)
    event.record()
    return event


def seconds_between(begin: Mark, end: Mark) -> float:
    """Seconds from one mark to a later one of the same device, which must have been reached."""
    return end - begin if isinstance(begin, float) else begin.elapsed_time(end) / 1e3


class Stopwatch(Watcher):
    """The time of each stage on ``device``, by events on CUDA; all calls of a stage count."""

    def __init__(self, device: torch.device):
        self.device = device
        self._open: list[Mark] = []
        self._spans: list[tuple[str, Mark, Mark]] = []

    def begin(self, stage: str, inputs: Inputs = ((), {})) -> None:
        self._open.append(time_mark(self.device))

    def end(self, stage: str, result: Any = None) -> None:
        self._spans.append((stage, self._open.pop(), time_mark(self.device)))

    def seconds(self) -> dict[str, float]:
        """Seconds of each stage, in the order in which they ended first; waits for the device."""
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)
        total: dict[str, float] = defaultdict(float)
        for stage, begin, stop in self._spans:
            total[stage] += seconds_between(begin, stop)
        return dict(total)


class Results(Watcher):
    """The last result of each stage, by its name."""

    def __init__(self) -> None:
        self.results: dict[str, Any] = {}

    def end(self, stage: str, result: Any = None) -> None:
        self.results[stage] = result
