"""Watchers of the stages of a model: when each begins and ends, its inputs and its result. The
model has no code for this: stages that are modules get hooks, others are wrapped while they
are watched."""

import time
from collections import defaultdict
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from operator import attrgetter
from typing import Any

import torch
from torch import nn

#: A point in time: seconds on the CPU, an event on CUDA.
Mark = float | torch.cuda.Event
#: Positional and named arguments of a stage.
Inputs = tuple[tuple, dict[str, Any]]


class Watcher:
    """Is called when stages begin and end, also nested ones; subclasses override what they need."""

    def begin(self, stage: str, inputs: Inputs = ((), {})) -> Inputs | None:
        """A stage begins.

        Args:
            stage: its name.
            inputs: positional and named arguments.

        Returns:
            Inputs that replace its own; None: they stay.
        """

    def end(self, stage: str, result: Any = None) -> None:
        """A stage ends.

        Args:
            stage: its name.
            result: what it returned.
        """


@contextmanager
def watched(model: nn.Module, stages: Mapping[str, str], watcher: Watcher) -> Iterator[None]:
    """Call a watcher at every call of stages while the context lasts.

    Args:
        model: whose stages are watched.
        stages: from names for the watcher to dotted paths in ``model``; a stage that is None or
            missing is left out.
        watcher: is called.
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
def inside(stage: str, watcher: Watcher) -> Iterator[None]:
    """Call ``watcher`` for a stage that lasts as long as the context.

    Args:
        stage: its name.
        watcher: is called.
    """
    watcher.begin(stage)
    yield
    watcher.end(stage)


def _hooks(stage: nn.Module, name: str, watcher: Watcher) -> tuple:
    return (
        stage.register_forward_pre_hook(lambda _, *inputs: watcher.begin(name, inputs), with_kwargs=True),
        stage.register_forward_hook(lambda _, __, result: watcher.end(name, result)),
    )


class Wrapped:
    """A stage that is no module, with a watcher of its calls."""

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
    """The present time on ``device``; on CUDA, when the work submitted so far is done."""
    if device.type != "cuda":
        return time.perf_counter()
    event = torch.cuda.Event(enable_timing=True)
    event.record(torch.cuda.current_stream(device))
    return event


def seconds_between(begin: Mark, end: Mark) -> float:
    """Seconds between two marks.

    Args:
        begin: of :func:`time_mark`.
        end: of the same device; both have been reached.
    """
    return end - begin if isinstance(begin, float) else begin.elapsed_time(end) / 1e3


class Stopwatch(Watcher):
    """Total time of the calls of each stage on ``device``, by events on CUDA."""

    def __init__(self, device: torch.device):
        self.device = device
        self._open: list[Mark] = []
        self._spans: list[tuple[str, Mark, Mark]] = []

    def begin(self, stage: str, inputs: Inputs = ((), {}), since: Mark | None = None) -> None:
        self._open.append(time_mark(self.device) if since is None else since)

    def end(self, stage: str, result: Any = None) -> None:
        self._spans.append((stage, self._open.pop(), time_mark(self.device)))

    def seconds(self) -> dict[str, float]:
        """Seconds of each stage, in the order of their first ends; waits for the device."""
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)
        total: dict[str, float] = defaultdict(float)
        for stage, begin, stop in self._spans:
            total[stage] += seconds_between(begin, stop)
        return dict(total)
