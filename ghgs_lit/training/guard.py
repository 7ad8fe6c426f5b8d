"""Guard against training steps that are not finite: they are explained, saved and skipped."""

import dataclasses
from functools import partial
from pathlib import Path

import lightning.pytorch as L
import torch
from torch import Tensor

from ghgs_lit.errors import InputError
from ghgs_lit.files import write_atomically
from ghgs_lit.training.faults import Step, first_fault


class DivergedError(InputError):
    """A loss or a gradient is not finite."""


class Guard:
    """Checks each step of the optimizer, and runs the step again only if it is not finite. All
    processes decide alike. The inputs of the step are saved to ``<run>/faults/step_<n>.pt``, once
    for each stage.

    Args:
        limit: steps in a row that are skipped before the run stops.

    Attributes:
        skipped: number of steps skipped in all sessions of the run."""

    def __init__(self, limit: int):
        self.limit = limit
        self.skipped = 0
        self._in_a_row = 0
        self._steps: list[tuple[Step, Tensor]] = []
        self._saved: set[str] = set()

    def note(self, step: Step, loss: Tensor) -> None:
        """Store a forward pass of the optimizer's next step; does not wait for the device.

        Args:
            step: its inputs.
            loss: its total loss, without dimensions."""
        self._steps.append((step, loss.detach()))

    def is_finite(self, trainer: L.Trainer, norm: Tensor) -> tuple[bool, bool]:
        """Check the next step of the optimizer. A training step waits for the device only here.

        Args:
            trainer: of the run.
            norm: of the gradient, without dimensions.

        Returns:
            Whether all losses since the last step, and whether the norm,
            are finite in all processes."""
        losses = torch.stack([loss for _, loss in self._steps]) if self._steps else norm.new_zeros(1)
        flags = torch.stack([losses.isfinite().all(), norm.isfinite()]).float()
        if trainer.world_size > 1:
            flags = trainer.strategy.reduce(flags, reduce_op="min")
        losses_hold, norm_holds = flags.tolist()
        return bool(losses_hold), bool(norm_holds)

    def accept(self) -> None:
        """Note that the step was finite, or that a scaler of the loss skips it."""
        self._steps.clear()
        self._in_a_row = 0

    def refuse(self, module: L.LightningModule, scale: float) -> None:
        """Explain and save the fault, and drop the gradients,
        so that the optimizer changes nothing.

        Args:
            module: that of :func:`~ghgs_lit.training.faults.first_fault`.
            scale: factor of the loss.

        Raises:
            DivergedError: more than ``limit`` steps in a row were not finite."""
        trainer = module.trainer
        line = self._explain(module, scale)
        self._steps.clear()
        lines = [line]
        if trainer.world_size > 1:
            lines = [""] * trainer.world_size
            torch.distributed.all_gather_object(lines, line)
        faults = "; ".join(filter(None, lines)) or "a value that is finite when the step is run again"
        message = f"step {module.global_step}: expected a finite loss and gradient; found {faults}"
        if self._in_a_row >= self.limit:
            raise DivergedError(message)
        self._in_a_row += 1
        self.skipped += 1
        for parameter in module.parameters():
            parameter.grad = None
        if trainer.is_global_zero:
            print(f"{message}; the step is skipped", flush=True)

    def _explain(self, module: L.LightningModule, scale: float) -> str:
        """The first fault of this process, "" if none, and, for the first fault of a stage,
        its file."""
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
            content = {**dataclasses.asdict(step), "autocast": str(step.autocast), "fault": str(fault)}
            write_atomically(path, partial(torch.save, content))
            return f"{fault}; its batch is in {path}"
        return ""
