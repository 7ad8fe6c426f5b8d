"""What is not finite in a training step: its weights, its data, a result, or a gradient."""

import dataclasses
import re
import warnings
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from ghgs_lit.kernels.watching import Watcher, watched
from ghgs_lit.model import STAGES
from ghgs_lit.types import Batch

if TYPE_CHECKING:  # it imports this module
    from ghgs_lit.training.module import GHGSModule


@dataclass(frozen=True)
class Step:
    """A forward and a backward pass, with all that it depends on beside the weights.

    ``budget`` is that of :func:`~ghgs_lit.training.module.drawn_budget`, ``scale`` the factor of the loss.
    """

    batch: Batch
    seed: int
    budget: str | int | None = None
    autocast: torch.dtype | None = None
    scale: float = 1.0


class _Faults(list[str], Watcher):
    """What is not finite, in the order in which it is seen."""

    def end(self, stage: str, result: Any = None) -> None:
        self.see(f"the result of {stage}", result)

    def see(self, place: str, value: Any) -> None:
        """Look at all tensors in ``value``."""
        for name, tensor in _tensors(value, place):
            if broken := int((~tensor.isfinite()).sum()):
                self.append(f"{broken} of {tensor.numel()} values are not finite in {name}")


def _tensors(value: Any, name: str) -> Iterator[tuple[str, Tensor]]:
    """The floating-point tensors in ``value``, and what to call them."""
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


def first_fault(module: "GHGSModule", step: Step) -> str | None:
    """Run ``step`` again: what is not finite first in weights, batch, results of modules, gradients.

    PyTorch's anomaly detection names the operation whose gradient is NaN. Weights and their gradients are not
    changed. None: all values are finite.
    """
    faults, model = _Faults(), module.model
    faults.see("the weights", dict(model.state_dict()))
    faults.see("the batch", step.batch)
    if faults:
        return faults[0]
    trained = {name: p for name, p in model.named_parameters() if p.requires_grad}
    with ExitStack() as stack, torch.enable_grad(), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of a mode that is slow
        stack.enter_context(torch.autograd.detect_anomaly())
        _watch(module, faults, stack)
        try:
            device, half = step.batch.images.device.type, step.autocast
            with torch.autocast(device, half, enabled=half is not None):
                _, total, _ = module.forward_losses(step)
            if not faults:
                slopes = torch.autograd.grad(total * step.scale, list(trained.values()), allow_unused=True)
                faults.see("the gradient", dict(zip(trained, slopes, strict=True)))
                norms = torch.tensor([float(slope.norm()) for slope in slopes if slope is not None])
                faults.see("the norm of the gradient", norms.norm())
        except Exception as error:  # of the detection, or of a stage that refuses what is not finite
            operation = re.match(r"Function '(\w+)Backward\d*' returned nan", str(error))
            if not faults and operation is None:
                raise
            faults += [f"NaN in the gradient of the operation {operation[1]}"] if operation else []
    return faults[0] if faults else None


def _watch(module: "GHGSModule", faults: _Faults, stack: ExitStack) -> None:
    """Until ``stack`` closes, ``faults`` sees the results of every layer and stage of ``module``."""
    for name, part in module.model.named_modules():
        hook = part.register_forward_hook(
            lambda part, inputs, result, name=name or "the model": faults.end(name, result)
        )
        stack.callback(hook.remove)
    paths = {name: f"model.{name}" for name in STAGES} | {name: name for name in ("renderer", "losses")}
    stack.enter_context(watched(module, paths, faults))
