"""The stages of a forward pass, seen from outside: probes that begin and end with each of them.

The model's ``forward`` knows nothing of this: stages that are modules get hooks, others are wrapped while a
probe watches.
"""

import dataclasses
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from operator import attrgetter
from typing import Any, Protocol

import torch
from torch import nn

from ghgs_lit.evaluation.measure import Renderer
from ghgs_lit.model import GHGS, STAGES
from ghgs_lit.training.clock import seconds_between, time_mark
from ghgs_lit.types import Batch, Prediction, Rendering

ROUNDS, RENDER, TOTAL = "rounds", "render", "total"
#: What lies in no stage: checks, padding.
OTHER = "other"
#: Parts of stages: a name ``<stage>.<part>``, and where the part is in the model.
PARTS = {"encoder.patch_tokens": "encoder.aggregator.patch_embed"}
#: All that is timed, in the order of the data flow. The stages without a dot add up to ``total``.
NAMES = (*STAGES[:1], *PARTS, *STAGES[1:], ROUNDS, RENDER, OTHER, TOTAL)


class Probe(Protocol):
    """What watches a forward pass."""

    def begin(self, stage: str) -> None:
        """``stage`` begins here."""

    def end(self, stage: str) -> None:
        """``stage`` ends here."""


class SecondsProbe:
    """The time of each stage, by events on CUDA; a stage that runs several times counts all of them."""

    def __init__(self, device: torch.device):
        self.device = device
        self._open: list[Any] = []
        self._spans: list[tuple[str, Any, Any]] = []

    def begin(self, stage: str) -> None:
        self._open.append(time_mark(self.device))

    def end(self, stage: str) -> None:
        self._spans.append((stage, self._open.pop(), time_mark(self.device)))

    def seconds(self) -> dict[str, float]:
        """Seconds of each stage, and of ``other``, in the order of :data:`NAMES`."""
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)
        found: dict[str, float] = defaultdict(float)
        for stage, begin, stop in self._spans:
            found[stage] += seconds_between(begin, stop)
        found[OTHER] = found[TOTAL] - sum(found[name] for name in top_level(found))
        return {name: found[name] for name in NAMES if name in found}


def top_level(names: Any) -> list[str]:
    """The names of stages that lie in no other and are not their sum."""
    return [name for name in names if "." not in name and name not in (OTHER, TOTAL)]


@torch.inference_mode()
def forward(model: GHGS, renderer: Renderer, batch: Batch, probe: Probe) -> tuple[Prediction, Rendering]:
    """Predict the Gaussians of a batch and render its targets, while ``probe`` watches."""
    with watched(model, probe), inside(TOTAL, probe):
        prediction = model(dataclasses.replace(batch, targets=None))
        with inside(RENDER, probe):
            rendering = renderer(prediction.gaussians, batch.targets.cameras)
    return prediction, rendering


@contextmanager
def watched(model: GHGS, probe: Probe) -> Iterator[None]:
    """Let ``probe`` see the stages of ``model`` and their parts."""
    with ExitStack() as stack:
        for name, path in {**{name: name for name in (*STAGES, ROUNDS)}, **PARTS}.items():
            stage = attrgetter(path)(model)
            if stage is None:  # a model without rounds
                continue
            if isinstance(stage, nn.Module):
                stack.enter_context(_hooked(stage, name, probe))
            else:
                stack.enter_context(_wrapped(model, stage, name, probe))
        yield


@contextmanager
def inside(name: str, probe: Probe) -> Iterator[None]:
    """Let ``probe`` see the stage ``name`` while the context lasts."""
    probe.begin(name)
    yield
    probe.end(name)


@contextmanager
def _hooked(stage: nn.Module, name: str, probe: Probe) -> Iterator[None]:
    hooks = [
        stage.register_forward_pre_hook(lambda *_: probe.begin(name)),
        stage.register_forward_hook(lambda *_: probe.end(name)),
    ]
    try:
        yield
    finally:
        for hook in hooks:
            hook.remove()


@contextmanager
def _wrapped(model: GHGS, stage: Callable, name: str, probe: Probe) -> Iterator[None]:
    setattr(model, name, _Watched(stage, name, probe))
    try:
        yield
    finally:
        setattr(model, name, stage)


class _Watched:
    """A stage that is no module, with a probe around each call."""

    def __init__(self, stage: Callable, name: str, probe: Probe):
        self._stage, self._name, self._probe = stage, name, probe

    def __call__(self, *arguments: Any, **options: Any) -> Any:
        with inside(self._name, self._probe):
            return self._stage(*arguments, **options)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stage, name)
