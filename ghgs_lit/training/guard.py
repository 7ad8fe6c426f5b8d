"""Guard against training steps with values that are not finite: finds the stage, saves the batch, and
skips the step or stops the run."""

import dataclasses
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import lightning.pytorch as L
import torch
from torch import Tensor

from ghgs_lit.errors import InputError
from ghgs_lit.files import write_atomically
from ghgs_lit.method.model import STAGES
from ghgs_lit.runtime.watching import Watcher, watch_stages
from ghgs_lit.training.optimization import named_weights
from ghgs_lit.types import Batch, map_tensors

#: Dotted paths of the stages to which faults are attributed.
_STAGES = {name: f"model.{name}" for name in (*STAGES, "rounds")}
_STAGES |= {"renderer": "renderer", "losses": "losses"}


@dataclass(frozen=True)
class Step:
    """All inputs of a forward pass except the weights.

    Args:
        batch: the batch of this process.
        seed: seed of all random numbers of the step.
        budget: which patches the encoder processes (:func:`~ghgs_lit.training.module.sample_budget`);
            None: as configured."""

    batch: Batch
    seed: int
    budget: str | int | None = None


class _FirstFault(Watcher):
    """Describes the first values that are not finite in ``text``; "": all are finite."""

    def __init__(self) -> None:
        self.text = ""

    def end(self, stage: str, result: Any = None) -> None:
        self.check(f"result of {stage}", result)

        def watch_gradient(tensor: Tensor) -> Tensor:
            if tensor.requires_grad:
                tensor.register_hook(partial(self.check, f"gradient of the result of {stage}"))
            return tensor

        map_tensors(result, watch_gradient)

    def check(self, place: str, value: Any) -> None:
        """Describe the values of ``place`` that are not finite, unless a fault was found before."""

        def check(tensor: Tensor) -> Tensor:
            broken = int((~tensor.isfinite()).sum())
            if broken and not self.text:
                self.text = f"{broken} of {tensor.numel()} values are not finite in the {place}"
            return tensor

        map_tensors(value, check)


def first_fault(module: L.LightningModule, step: Step, scale: float = 1.0) -> str:
    """Repeat a step, and find the first values that are not finite in weights, batch, results of stages
    and gradients. Weights and their gradients are not changed.

    Args:
        module: module whose ``forward_losses`` returns the loss of a step first, such as
            :class:`~ghgs_lit.training.module.GHGSModule`.
        scale: factor of the loss (``16-mixed``).

    Returns:
        The number of such values and their place, in words; "": all are finite."""
    fault = _FirstFault()
    trained = {}
    for name, weight in named_weights(module):
        fault.check(f"weights {name}", weight)
        if weight.requires_grad:
            trained[name] = weight
    fault.check("batch", step.batch)
    precision = module.trainer.precision_plugin
    try:
        with torch.enable_grad(), watch_stages(module, _STAGES, fault), precision.train_step_context():
            slopes = torch.autograd.grad(
                module.forward_losses(step)[0] * scale, list(trained.values()), allow_unused=True
            )
    except Exception:  # a stage may reject values that are not finite
        if not fault.text:
            raise
        return fault.text
    for name, slope in zip(trained, slopes, strict=True):
        fault.check(f"gradient of {name}", slope)
    return fault.text


class Guard:
    """Checks that the loss and the gradient of each step are finite. A step that is not is repeated to
    find the fault, its inputs are saved to ``<run>/faults/step_of_process_<rank>.pt``, and it is skipped.
    All processes make the same decision.

    Args:
        limit: maximum number of consecutive steps that are skipped before the run stops.

    Attributes:
        skipped: number of steps skipped in all sessions of the run."""

    def __init__(self, limit: int):
        self.limit = limit
        self.skipped = 0
        self._in_a_row = 0
        self._steps: list[tuple[Step, Tensor]] = []

    def note(self, step: Step, loss: Tensor) -> None:
        """Store a forward pass of the optimizer's next step and its loss, without a synchronisation."""
        self._steps.append((step, loss.detach()))

    def check(self, module: L.LightningModule, norm: Tensor, scaler: torch.amp.GradScaler | None) -> bool:
        """Check the next step of the optimizer; a training step's only device-to-host synchronisation.

        A gradient that overflows with a factor above 1 is left to the gradient scaler, which skips the
        step and halves the factor.

        Args:
            module: see :func:`first_fault`; the gradients of a step to be skipped are removed.
            norm: norm of the gradient, a scalar.
            scaler: scaler of the loss (``16-mixed``), if any.

        Returns:
            Whether all losses since the last step, and the norm, are finite in all processes.

        Raises:
            InputError: more than ``limit`` consecutive steps were not finite."""
        losses = torch.stack([loss for _, loss in self._steps])
        flags = torch.stack([losses.isfinite().all(), norm.isfinite()]).float()
        if module.trainer.world_size > 1:
            flags = module.trainer.strategy.reduce(flags, reduce_op="min")
        loss_holds, norm_holds = flags.tolist()
        is_finite = bool(loss_holds and norm_holds)
        scale = 1.0 if is_finite or scaler is None else scaler.get_scale()
        if is_finite or (loss_holds and scale > 1):
            self._in_a_row = 0
        else:
            self._skip(module, scale)
        self._steps.clear()
        return is_finite

    def _skip(self, module: L.LightningModule, scale: float) -> None:
        """Find and save the fault, and remove the gradients, so that the optimizer changes nothing."""
        trainer = module.trainer
        fault = self._explain(module, scale)
        faults = [fault] * trainer.world_size
        if trainer.world_size > 1:
            torch.distributed.all_gather_object(faults, fault)
        found = "; ".join(filter(None, faults)) or "values that are finite one by one, or when run again"
        message = f"step {module.global_step}: expected a finite loss and gradient; found {found}"
        if self._in_a_row >= self.limit:
            raise InputError(message)
        self._in_a_row += 1
        self.skipped += 1
        module.zero_grad()
        if trainer.is_global_zero:
            print(f"{message}; the step is skipped", flush=True)

    def _explain(self, module: L.LightningModule, scale: float) -> str:
        """Describe the first fault of this process, and name the file with its batch; "": no fault."""
        for step, _ in self._steps:
            if fault := first_fault(module, step, scale):
                folder = Path(module.trainer.default_root_dir) / "faults"
                path = folder / f"step_of_process_{module.global_rank}.pt"
                write_atomically(path, partial(torch.save, dataclasses.asdict(step) | {"fault": fault}))
                return f"{fault}; its batch is in {path}"
        return ""
