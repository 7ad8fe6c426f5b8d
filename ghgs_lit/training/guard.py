"""Guard against training steps that are not finite: they are explained, saved and skipped."""

import dataclasses
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import lightning.pytorch as L
import torch
from torch import Tensor

from ghgs_lit.errors import InputError
from ghgs_lit.files import write_atomically
from ghgs_lit.kernels.watching import Inputs, Watcher, watched
from ghgs_lit.model import STAGES
from ghgs_lit.types import Batch, map_tensors

if TYPE_CHECKING:  # it imports this module
    from ghgs_lit.training.module import GHGSModule

#: Stages that faults are assigned to; other modules count as ``model``.
_STAGES = (*STAGES, "renderer", "losses")


@dataclass(frozen=True)
class Step:
    """All inputs of a forward and a backward pass except the weights. ``budget``: see
    :func:`~ghgs_lit.training.module.drawn_budget`. ``scale``: factor of the loss."""

    batch: Batch
    seed: int
    budget: str | int | None = None
    autocast: torch.dtype | None = None
    scale: float = 1.0


@dataclass(frozen=True)
class Fault:
    """Values that are not finite. ``place``: their tensor. ``sample``: the subject that causes them."""

    values: str
    where: str
    stage: str
    place: str
    sample: str | None = None

    def __str__(self) -> str:
        sample = "" if self.sample is None else f", subject {self.sample}"
        return f"{self.values} in the {self.where} {self.stage} ({self.place}{sample})"


class _Faults(list[Fault], Watcher):
    """Faults in results of stages and in gradients of their inputs, in the order in which they occur."""

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
        self.see("result of", stage, result)

    def see(self, where: str, place: str, value: Any, stage: str | None = None) -> None:
        """Check all tensors in ``value``. ``stage``: None: the stage at the beginning of ``place``."""
        for name, tensor in _tensors(value, place):
            if broken := int((~tensor.isfinite()).sum()):
                values = f"{broken} of {tensor.numel()} values are not finite"
                self.append(Fault(values, where, stage or _stage_of(place), name))


def _stage_of(place: str) -> str:
    first = place.split(".")[0]
    return first if first in _STAGES else "model"


def _tensors(value: Any, name: str) -> Iterator[tuple[str, Tensor]]:
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


def first_fault(module: "GHGSModule", step: Step) -> Fault | None:
    """The first fault when ``step`` is run again, in weights, batch, results of modules, and gradients. A
    faulty batch is run again subject by subject, to find the first one that is faulty alone. Weights and
    their gradients are not changed. None: all values are finite."""
    fault = _search(module, step)
    if fault is None or fault.where == "weights of":
        return fault
    for element in range(len(step.batch.images)):
        alone = dataclasses.replace(step, batch=_one_subject(step.batch, element))
        if len(step.batch.images) == 1 or _search(module, alone) is not None:
            subjects = step.batch.subjects
            return dataclasses.replace(fault, sample=subjects[element] if subjects else str(element))
    return fault


def _search(module: "GHGSModule", step: Step) -> Fault | None:
    faults, model, device = _Faults(), module.model, step.batch.images.device.type
    for name, value in (*model.named_parameters(), *model.named_buffers()):
        faults.see("weights of", name, value)
    faults.see("data that enters", "batch", step.batch, "the model")
    trained = {name: p for name, p in model.named_parameters() if p.requires_grad}
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


def _watch(module: "GHGSModule", faults: _Faults, stack: ExitStack) -> None:
    """Let ``faults`` check results of all modules and gradients of all parameters until ``stack`` closes."""
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
    one = slice(element, element + 1)
    bodies, targets = batch.body_vertices, batch.targets
    part = map_tensors(dataclasses.replace(batch, body_vertices=None), lambda t: t[one])
    return dataclasses.replace(
        part,
        targets=targets and dataclasses.replace(part.targets, names=targets.names[one]),
        body_vertices=bodies and bodies[one],
        subjects=batch.subjects[one],
        views=batch.views[one],
    )


class DivergedError(InputError):
    """A loss or a gradient is not finite."""


class Guard:
    """Checks each step of the optimizer, and runs the step again only if it is not finite. All processes
    decide alike. A fault is saved to ``<run>/faults/step_<n>.pt`` (once for each stage), which
    :mod:`ghgs_lit.training.replay` can run again. ``limit``: steps in a row that are skipped before the run
    stops. ``skipped``: steps skipped in all sessions of the run."""

    def __init__(self, limit: int):
        self.limit, self.skipped = limit, 0
        self._in_a_row = 0
        self._steps: list[tuple[Step, Tensor]] = []
        self._saved: set[str] = set()

    def note(self, step: Step, loss: Tensor) -> None:
        """Store a forward pass of the optimizer's next step, and its loss; does not wait for the device."""
        self._steps.append((step, loss.detach()))

    def is_finite(self, trainer: L.Trainer, norm: Tensor) -> tuple[bool, bool]:
        """Whether all losses since the last step, and whether the gradient's ``norm``, are finite in all
        processes. A training step waits for the device only here."""
        losses = torch.stack([loss for _, loss in self._steps]) if self._steps else norm.new_zeros(1)
        flags = torch.stack([losses.isfinite().all(), norm.isfinite()]).float()
        if trainer.world_size > 1:
            flags = trainer.strategy.reduce(flags, reduce_op="min")
        return tuple(bool(flag) for flag in flags.tolist())

    def accept(self) -> None:
        """Note that the step was finite, or that a scaler of the loss skips it."""
        self._steps.clear()
        self._in_a_row = 0

    def refuse(self, module: L.LightningModule, scale: float) -> None:
        """Explain and save the fault, and drop the gradients, so that the optimizer changes nothing.
        DivergedError: more than ``limit`` steps in a row were not finite."""
        trainer, line = module.trainer, self._explain(module, scale)
        self._steps.clear()
        lines = [line]
        if trainer.world_size > 1:
            lines = [""] * trainer.world_size
            torch.distributed.all_gather_object(lines, line)
        said = "; ".join(filter(None, lines)) or "a value that is finite when the step is run again"
        said = f"step {module.global_step}: expected a finite loss and gradient; found {said}"
        if self._in_a_row >= self.limit:
            raise DivergedError(said)
        self._in_a_row += 1
        self.skipped += 1
        for parameter in module.parameters():
            parameter.grad = None
        if trainer.is_global_zero:
            print(f"{said}; the step is skipped", flush=True)

    def _explain(self, module: L.LightningModule, scale: float) -> str:
        """The first fault of this process, "" if none, and, for the first fault of a stage, its file."""
        for step, _ in self._steps:
            step = dataclasses.replace(step, scale=scale)
            if (fault := first_fault(module, step)) is None:
                continue
            if fault.stage in self._saved:
                return str(fault)
            self._saved.add(fault.stage)
            rank = f"_process_{module.global_rank}" if module.global_rank else ""
            folder = Path(module.trainer.default_root_dir) / "faults"
            path = folder / f"step_{module.global_step:06d}{rank}.pt"
            _write(path, module, step, fault)
            return f"{fault}; `ghgs stress dump={path}` runs it again"
        return ""


def _write(path: Path, module: L.LightningModule, step: Step, fault: Fault) -> None:
    content = {
        "fault": str(fault),
        "global_step": module.global_step,
        "step": {**dataclasses.asdict(step), "autocast": str(step.autocast or "").removeprefix("torch.")},
        "state_dict": module.model.state_dict(),
        "optimizer_states": [optimizer.state_dict() for optimizer in module.trainer.optimizers],
        "config": dict(module.config),
    }
    write_atomically(path, lambda temporary: torch.save(content, temporary))
