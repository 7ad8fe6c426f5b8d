"""Finding the first value of a training step that is not finite: its stage, its place and its sample."""

import dataclasses
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from ghgs_lit.model import STAGES
from ghgs_lit.types import Batch, map_tensors

if TYPE_CHECKING:
    from ghgs_lit.training.module import GHGSModule


@dataclass(frozen=True)
class Step:
    """A forward and a backward pass, with all that it depends on beside the weights.

    ``budget`` is that of :class:`~ghgs_lit.training.budgets.TokenBudgets`, ``autocast`` the dtype (None:
    without), ``scale`` the factor of the loss (``16-mixed``).
    """

    batch: Batch
    seed: int
    budget: str | int | None = None
    autocast: torch.dtype | None = None
    scale: float = 1.0


@dataclass(frozen=True)
class Fault:
    """The first value that is not finite.

    Args:
        phase: ``weights``, ``batch``, ``forward`` or ``backward``.
        stage: of the model, ``renderer`` or ``losses``; of weights, the stage that they belong to.
        place: the tensor: a parameter, a field of the batch, or a module and the field of its result.
        values: how many of its values are not finite.
        sample: the subject; None where no sample alone is at fault.
    """

    phase: str
    stage: str
    place: str
    values: str
    sample: str | None = None

    def __str__(self) -> str:
        where = {
            "weights": "in the weights of",
            "batch": "in the data that enters",
            "forward": "in the result of",
            "backward": "in the gradient from",
        }[self.phase]
        sample = "" if self.sample is None else f", subject {self.sample}"
        return f"{self.values} {where} {self.stage} ({self.place}{sample})"


class _Watch:
    """Remembers the first value that is not finite."""

    def __init__(self) -> None:
        self.fault: Fault | None = None

    def see(self, phase: str, stage: str, place: str, value: Any) -> None:
        if self.fault is None and (found := _first_broken(value, place)) is not None:
            self.fault = Fault(phase, stage, *found)


def _first_broken(value: Any, place: str) -> tuple[str, str] | None:
    """The place of the first tensor in ``value`` that is not finite, and how much of it is not."""
    if isinstance(value, Tensor):
        if not value.is_floating_point():
            return None
        broken = int((~value.isfinite()).sum())
        return (place, f"{broken} of {value.numel()} values are not finite") if broken else None
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        inner = [(f"{place}.{f.name}", getattr(value, f.name)) for f in dataclasses.fields(value)]
    elif isinstance(value, Mapping):
        inner = [(f"{place}.{name}", item) for name, item in value.items()]
    elif isinstance(value, (tuple, list)):
        inner = [(place, item) for item in value]
    else:
        return None
    return next((found for name, item in inner if (found := _first_broken(item, name))), None)


def first_fault(module: "GHGSModule", step: Step) -> Fault | None:
    """Run ``step`` again and look at every value: weights, batch, results of all modules, gradients.

    A batch that is at fault is run again sample by sample, to name the one that is at fault alone.

    Args:
        module: with the weights of the step; they and their gradients are not changed.
        step: what to run.

    Returns:
        The first fault in the order of computation; None where all values are finite.
    """
    fault = _search(module, step)
    if fault is None or fault.phase == "weights":
        return fault
    for element in range(len(step.batch.images)):
        alone = dataclasses.replace(step, batch=_one_element(step.batch, element))
        if len(step.batch.images) == 1 or _search(module, alone) is not None:
            subjects = step.batch.subjects
            return dataclasses.replace(fault, sample=subjects[element] if subjects else str(element))
    return fault


def _search(module: "GHGSModule", step: Step) -> Fault | None:
    watch, device = _Watch(), step.batch.images.device.type
    for name, value in (*module.model.named_parameters(), *module.model.named_buffers()):
        watch.see("weights", _stage_of(name), name, value)
    watch.see("batch", "the model", "batch", step.batch)
    if watch.fault is not None:
        return watch.fault
    trained = {name: p for name, p in module.model.named_parameters() if p.requires_grad}
    with _watched(module, watch), torch.enable_grad():
        try:
            with torch.autocast(device, step.autocast, enabled=step.autocast is not None):
                _, total, _ = module.forward_losses(step)
        except Exception:  # a later stage may refuse what is not finite
            if watch.fault is None:
                raise
        if watch.fault is None:
            slopes = torch.autograd.grad(total * step.scale, list(trained.values()), allow_unused=True)
            _see_norm(watch, dict(zip(trained, slopes, strict=True)))
    return watch.fault


def _see_norm(watch: _Watch, slopes: Mapping[str, Tensor | None]) -> None:
    """Finite gradients whose norm is not finite: the largest one is named."""
    norms = {name: slope.norm() for name, slope in slopes.items() if slope is not None}
    if norms:
        total = torch.stack(list(norms.values())).norm()
        name = max(norms, key=lambda name: float(norms[name]))
        watch.see("backward", _stage_of(name), f"norm, largest of {name}", total)


def _stage_of(name: str) -> str:
    """The stage that a module or parameter of the model belongs to."""
    first = name.split(".")[0]
    return first if first in STAGES else "model"


@contextmanager
def _watched(module: "GHGSModule", watch: _Watch) -> Iterator[None]:
    """While the context lasts, ``watch`` sees the results and the gradients of every stage of ``module``."""
    model = module.model
    stages = [(model, name) for name in STAGES if hasattr(model, name)]
    stages += [(module, "renderer"), (module, "losses")]
    hooks, replaced = [], []
    try:
        for name, part in model.named_modules():
            hooks.append(part.register_forward_hook(_looking(watch, name or "model")))
        for name, parameter in model.named_parameters():
            if parameter.requires_grad:
                stage = _stage_of(name)
                hooks.append(
                    parameter.register_hook(lambda g, s=stage, n=name: watch.see("backward", s, n, g))
                )
        for owner, name in stages:
            stage = getattr(owner, name)
            if isinstance(stage, nn.Module):
                hooks.append(stage.register_forward_pre_hook(_receiving(watch, name), with_kwargs=True))
            else:
                replaced.append((owner, name, stage))
                setattr(owner, name, _around(watch, name, stage))
        yield
    finally:
        for hook in hooks:
            hook.remove()
        for owner, name, stage in replaced:
            setattr(owner, name, stage)


def _looking(watch: _Watch, name: str) -> Callable[..., None]:
    return lambda part, inputs, result: watch.see("forward", _stage_of(name), name, result)


def _receiving(watch: _Watch, stage: str) -> Callable[..., tuple]:
    """Gives a stage its own views of its inputs, whose gradients are those from this stage alone."""

    def own(value: Tensor) -> Tensor:
        if not value.requires_grad:
            return value
        view = value.view_as(value)
        view.register_hook(lambda g: watch.see("backward", stage, "an input", g))
        return view

    return lambda part, inputs, options: (map_tensors(inputs, own), map_tensors(options, own))


def _around(watch: _Watch, name: str, stage: Callable[..., Any]) -> Callable[..., Any]:
    """As the hooks of a module, for a stage that is none."""

    def call(*inputs: Any, **options: Any) -> Any:
        inputs, options = _receiving(watch, name)(None, inputs, options)
        result = stage(*inputs, **options)
        watch.see("forward", name, name, result)
        return result

    return call


def _one_element(batch: Batch, element: int) -> Batch:
    """A batch of one of its samples."""
    own = slice(element, element + 1)
    bodies, targets = batch.body_vertices, batch.targets
    part = map_tensors(dataclasses.replace(batch, body_vertices=None), lambda t: t[own])
    return dataclasses.replace(
        part,
        targets=targets and dataclasses.replace(part.targets, names=targets.names[own]),
        body_vertices=bodies and bodies[own],
        subjects=batch.subjects[own],
        views=batch.views[own],
    )
