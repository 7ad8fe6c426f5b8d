"""The first value of a training step that is not finite: where it is,
and which subject causes it."""

import dataclasses
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from typing import Any

import lightning.pytorch as L
import torch
from torch import Tensor

from ghgs_lit.method.model import STAGES
from ghgs_lit.runtime.watching import Inputs, Watcher, watched
from ghgs_lit.training.optimization import named_weights
from ghgs_lit.types import Batch, map_tensors

#: Stages that faults are assigned to; other modules count as ``model``.
_STAGES = (*STAGES, "renderer", "losses")


@dataclass(frozen=True)
class Step:
    """All inputs of a forward and a backward pass except the weights.

    Args:
        batch: of this process.
        seed: of all random numbers that the step draws.
        budget: which patches the encoder sees (:func:`~ghgs_lit.training.module.drawn_budget`);
            None: as configured.
        autocast: type of products in mixed precision; None: float32.
        scale: factor of the loss (``16-mixed``).
        rounds: number of rounds; None: drawn by the seed."""

    batch: Batch
    seed: int
    budget: str | int | None = None
    autocast: torch.dtype | None = None
    scale: float = 1.0
    rounds: int | None = None


@dataclass(frozen=True)
class Fault:
    """Values that are not finite.

    Args:
        values: how many of how many.
        where: what they are to the stage, such as ``result of`` or ``weights of``.
        stage: a stage of the model, ``renderer``, ``losses`` or ``model``.
        place: their tensor.
        sample: the subject that causes them; None: not known, or all do."""

    values: str
    where: str
    stage: str
    place: str
    sample: str | None = None

    def __str__(self) -> str:
        sample = "" if self.sample is None else f", subject {self.sample}"
        return f"{self.values} in the {self.where} {self.stage} ({self.place}{sample})"


class _Faults(list[Fault], Watcher):
    """Faults in results of stages and in gradients of their inputs,
    in the order in which they occur."""

    def begin(self, stage: str, inputs: Inputs = ((), {})) -> Inputs:
        """Views of the inputs, whose gradients come from this stage alone."""

        def view(value: Tensor) -> Tensor:
            if not value.requires_grad:
                return value
            value = value.view_as(value)
            value.register_hook(lambda slope: self.see("gradient from", "an input", slope, stage))
            return value

        return map_tensors(inputs, view)

    def end(self, stage: str, result: Any = None) -> None:
        """Check the result of a stage."""
        self.see("result of", stage, result)

    def see(self, where: str, place: str, value: Any, stage: str | None = None) -> None:
        """Check all tensors in a value.

        Args:
            where: what the value is to the stage.
            place: name of the value.
            value: a tensor, or lists, mappings and dataclasses of them.
            stage: None: the stage at the beginning of ``place``."""
        for name, tensor in _tensors(value, place):
            if broken := int((~tensor.isfinite()).sum()):
                values = f"{broken} of {tensor.numel()} values are not finite"
                self.append(Fault(values, where, stage or _stage_of(place), name))


def _stage_of(place: str) -> str:
    """The stage that a tensor belongs to, from its name."""
    first = place.split(".")[0]
    return first if first in _STAGES else "model"


def _tensors(value: Any, name: str) -> Iterator[tuple[str, Tensor]]:
    """Names and values of all floating point tensors in lists, mappings and dataclasses."""
    if isinstance(value, Tensor) and value.is_floating_point():
        yield name, value
    elif isinstance(value, (tuple, list)):
        for item in value:
            yield from _tensors(item, name)
    elif isinstance(value, Mapping):
        for key, item in value.items():
            yield from _tensors(item, f"{name}.{key}")
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        for field in dataclasses.fields(value):
            yield from _tensors(getattr(value, field.name), f"{name}.{field.name}")


def first_fault(module: L.LightningModule, step: Step) -> Fault | None:
    """Run a step again, and find its first fault in weights, batch, results of modules,
    and gradients.

    A faulty batch is run again subject by subject, to find the first one that is faulty alone.
    Weights and their gradients are not changed.

    Args:
        module: with ``model``, ``renderer``, ``losses`` and ``forward_losses``, as
            :class:`~ghgs_lit.training.module.GHGSModule`.
        step: the inputs.

    Returns:
        The first fault; None: all values are finite."""
    fault = _search(module, step)
    if fault is None or fault.where == "weights of":
        return fault
    for element in range(len(step.batch.images)):
        alone = dataclasses.replace(step, batch=_one_subject(step.batch, element))
        if len(step.batch.images) == 1 or _search(module, alone) is not None:
            subjects = step.batch.subjects
            return dataclasses.replace(fault, sample=subjects[element] if subjects else str(element))
    return fault


def _search(module: L.LightningModule, step: Step) -> Fault | None:
    """The first fault of a step, whose batch is taken as a whole."""
    faults = _Faults()
    device = step.batch.images.device.type
    weights = dict(named_weights(module))
    for name, value in (*weights.items(), *module.model.named_buffers()):
        faults.see("weights of", name, value)
    faults.see("data that enters", "batch", step.batch, "the model")
    trained = {name: weight for name, weight in weights.items() if weight.requires_grad}
    with ExitStack() as stack, torch.enable_grad():
        if faults:
            return faults[0]
        _watch(module, faults, stack)
        try:
            with torch.autocast(device, step.autocast, enabled=step.autocast is not None):
                _, total, _ = module.forward_losses(step)
        except Exception:  # a later stage may refuse values that are not finite
            if not faults:
                raise
        if not faults:
            slopes = torch.autograd.grad(total * step.scale, list(trained.values()), allow_unused=True)
            norms = {n: slope.norm() for n, slope in zip(trained, slopes, strict=True) if slope is not None}
            if norms:  # if all are finite, the largest is named
                name = max(norms, key=lambda name: float(norms[name]))
                norm = torch.stack(list(norms.values())).norm()
                faults.see("gradient from", f"norm, largest of {name}", norm, _stage_of(name))
    return faults[0] if faults else None


def _watch(module: L.LightningModule, faults: _Faults, stack: ExitStack) -> None:
    """Let ``faults`` check results of all modules and gradients of all parameters until
    ``stack`` closes."""
    model = module.model
    for name, part in model.named_modules():
        hook = part.register_forward_hook(
            lambda part, inputs, result, name=name or "model": faults.see("result of", name, result)
        )
        stack.callback(hook.remove)
    for name, parameter in model.named_parameters():
        if parameter.requires_grad:
            stack.callback(parameter.register_hook(partial(faults.see, "gradient from", name)).remove)
    paths = {name: f"model.{name}" if name in STAGES else name for name in _STAGES}
    stack.enter_context(watched(module, paths, faults))


def _one_subject(batch: Batch, element: int) -> Batch:
    """One element of a batch, alone."""
    one = slice(element, element + 1)
    bodies = batch.body_vertices
    targets = batch.targets
    part = map_tensors(dataclasses.replace(batch, body_vertices=None), lambda t: t[one])
    return dataclasses.replace(
        part,
        targets=targets and dataclasses.replace(part.targets, names=targets.names[one]),
        body_vertices=bodies and bodies[one],
        subjects=batch.subjects[one],
        views=batch.views[one],
    )
