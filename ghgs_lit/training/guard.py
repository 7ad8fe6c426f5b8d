"""Guard against training steps with values that are not finite: names the first, saves the batch, and skips
the step or stops the run."""

import dataclasses
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import lightning.pytorch as L
import torch
from torch import Tensor

from ghgs_lit.errors import InputError
from ghgs_lit.files import write_atomically
from ghgs_lit.training.optimization import named_weights
from ghgs_lit.types import Batch, map_tensors


def find_fault(places: Mapping[str, Any]) -> str:
    """Find the first values that are not finite.

    Args:
        places: tensors, or containers of tensors, by a description in words.

    Returns:
        Their number and their place, in words; "": all are finite."""
    faults = []
    for place, value in places.items():

        def check(tensor: Tensor, place: str = place) -> Tensor:
            broken = int((~tensor.isfinite()).sum())
            if broken:
                faults.append(f"{broken} of {tensor.numel()} values are not finite in the {place}")
            return tensor

        map_tensors(value, check)
    return faults[0] if faults else ""


class Guard:
    """Checks that the loss and the gradient of each step are finite. The batch of a step that is not is saved
    to ``<run>/faults/step_of_process_<rank>.pt``, and the step is skipped. All processes make the same
    decision.

    Args:
        limit: maximum number of consecutive steps that are skipped before the run stops.

    Attributes:
        skipped: number of steps skipped in all sessions of the run."""

    def __init__(self, limit: int):
        self.limit = limit
        self.skipped = 0
        self._in_a_row = 0
        self._passes: list[tuple[Batch, dict[str, Tensor]]] = []

    def note(self, batch: Batch, total: Tensor, terms: Mapping[str, Tensor]) -> None:
        """Store a forward pass of the optimizer's next step with its loss and the loss's terms, without a
        synchronisation."""
        values = {f"term {name} of the loss": value.detach() for name, value in terms.items()}
        self._passes.append((batch, values | {"loss": total.detach()}))

    def check(self, module: L.LightningModule, norm: Tensor, scaler: torch.amp.GradScaler | None) -> bool:
        """Check the next step of the optimizer; a training step's only device-to-host synchronisation.

        A gradient that overflows with a factor above 1 is left to the gradient scaler, which skips the
        step and halves the factor.

        Args:
            module: its gradients are unscaled; those of a step to be skipped are removed.
            norm: norm of the gradient, a scalar.
            scaler: scaler of the loss (``16-mixed``), if any.

        Returns:
            Whether all losses since the last step, and the norm, are finite in all processes.

        Raises:
            InputError: more than ``limit`` consecutive steps were not finite."""
        losses = torch.stack([values["loss"] for _, values in self._passes])
        flags = torch.stack([losses.isfinite().all(), norm.isfinite()]).float()
        if module.trainer.world_size > 1:
            flags = module.trainer.strategy.reduce(flags, reduce_op="min")
        loss_holds, norm_holds = flags.tolist()
        is_finite = bool(loss_holds and norm_holds)
        scale = 1.0 if is_finite or scaler is None else scaler.get_scale()
        if is_finite or (loss_holds and scale > 1):
            self._in_a_row = 0
        else:
            self._skip(module, bool(loss_holds))
        self._passes.clear()
        return is_finite

    def _skip(self, module: L.LightningModule, loss_holds: bool) -> None:
        """Find and save the fault, and remove the gradients, so that the optimizer changes nothing."""
        trainer = module.trainer
        fault = self._explain(module, loss_holds)
        faults = [fault] * trainer.world_size
        if trainer.world_size > 1:
            torch.distributed.all_gather_object(faults, fault)
        found = "; ".join(filter(None, faults)) or "values that are finite one by one"
        message = f"step {module.global_step}: expected a finite loss and gradient; found {found}"
        if self._in_a_row >= self.limit:
            raise InputError(message)
        self._in_a_row += 1
        self.skipped += 1
        module.zero_grad()
        if trainer.is_global_zero:
            print(f"{message}; the step is skipped", flush=True)

    def _explain(self, module: L.LightningModule, loss_holds: bool) -> str:
        """Describe the first fault of this process, and name the file with its batch; "": no fault."""
        named = dict(named_weights(module))
        weights = {f"weights {name}": weight for name, weight in named.items()}
        # A loss that is not finite spoils all gradients, in all processes.
        gradients = {f"gradient of {name}": weight.grad for name, weight in named.items() if loss_holds}
        for batch, values in self._passes:
            if fault := find_fault(weights | {"batch": batch} | values | gradients):
                folder = Path(module.trainer.default_root_dir) / "faults"
                path = folder / f"step_of_process_{module.global_rank}.pt"
                content = {"batch": dataclasses.asdict(batch), "fault": fault}
                write_atomically(path, partial(torch.save, content))
                return f"{fault}; its batch is in {path}"
        return ""
