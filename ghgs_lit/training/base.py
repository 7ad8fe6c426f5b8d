"""Base of the LightningModules: a learning-rate schedule over the run's budget of steps or time,
and checkpoints of plain data."""

from collections.abc import Mapping
from typing import Any

import lightning.pytorch as L
import numpy as np
import torch
from lightning.pytorch.callbacks import Timer
from torch import Tensor, nn
from torchmetrics import MeanMetric

from ghgs_lit.errors import InputError, require
from ghgs_lit.training.guard import Guard, Step
from ghgs_lit.training.optimization import Optimization, convert_rates_to_numbers, hold_rates
from ghgs_lit.types import Batch
from ghgs_lit.weights.checkpoint import FORMAT_VERSION


def image_mean() -> MeanMetric:
    """Mean over all images of a validation, in float64; ignores NaN."""
    return MeanMetric(nan_strategy="ignore").set_dtype(torch.float64)


class BudgetedModule(L.LightningModule):
    """LightningModule whose learning rate depends on the used share of the run's budget.

    Args:
        model: the model to train. Other submodules with weights, such as a loss, are trained, clipped,
            frozen and saved with it; checkpoints store the model's tensors under ``model.`` and those
            of other submodules under their names.
        optimization: options of the optimizer and its schedule.
        config: the run's full configuration as plain data, with ``seed`` (0 if missing). Checkpoints
            contain it, merged into the model's configuration. None: only the model's.

    Attributes:
        used_budget: used share of the run's budget in [0, 1] at the last step."""

    def __init__(self, model: nn.Module, optimization: Optimization, config: Mapping[str, Any] | None):
        super().__init__()
        self.model = model
        self.optimization = optimization
        self.config = {**getattr(model, "config", {}), **(config or {})}
        self.used_budget = 0.0
        self.guard = Guard(getattr(optimization, "skip_nonfinite", 0))  # a plug-in may lack this option

    def transfer_batch_to_device(self, batch: Batch, device: torch.device, dataloader_idx: int) -> Batch:
        """Copy a batch to a device, without a synchronisation if its memory is pinned."""
        # Lightning copies unknown structures tensor by tensor and synchronises after each.
        return batch.to(device, non_blocking=device.type != "cpu")

    def on_train_start(self) -> None:
        """Resume the used share of the budget, and apply this run's options of the optimizer."""
        # After a restart the scheduler would update it only at the end of the first step.
        self.used_budget = self.progress()
        # Lightning has restored the options that the checkpoint was trained with.
        optimizer = self.optimizers()
        schedule = self.lr_schedulers()
        for number, (group, option) in enumerate(zip(optimizer.param_groups, self._options, strict=True)):
            # The restored rate includes the schedule's factor for the next step.
            rate = group["lr"] * option["lr"] / schedule.base_lrs[number]
            group.update(option, lr=rate, initial_lr=option["lr"])
            schedule.base_lrs[number] = option["lr"]
        hold_rates(optimizer)

    def on_train_batch_start(self, *args: Any) -> None:
        """Correct Lightning's count of steps, which is one too high after a run resumes from the end of
        an earlier session."""
        self.trainer.fit_loop.epoch_loop._batches_that_stepped = self.global_step

    def step_seed(self, batch_idx: int) -> int:
        """Seed of this step's random numbers, the same after an interruption and in all processes, so
        that all sample the same number of rounds and none waits for another.

        Args:
            batch_idx: Lightning's index, which distinguishes the batches of an accumulated step.

        Returns:
            A 32-bit number, hashed from :meth:`step_numbers`."""
        return int(np.random.SeedSequence(self.step_numbers(batch_idx)).generate_state(1)[0])

    def step_numbers(self, batch_idx: int) -> list[int]:
        """The run's seed, the step, and the index of the batch within an accumulated step. Together they
        seed all randomness of the step."""
        part = batch_idx % self.trainer.accumulate_grad_batches
        return [self.config.get("seed", 0), self.global_step, part]

    def progress(self) -> float:
        """Used share of the budget of steps or of time, whichever is larger.

        Returns:
            A number in [0, 1], the same in all processes.

        Raises:
            InputError: the run has no budget."""
        trainer = self.trainer
        shares = []
        if trainer.max_steps > 0:
            shares.append(self.global_step / trainer.max_steps)
        for timer in trainer.callbacks:
            if not isinstance(timer, Timer) or timer.time_remaining() is None:
                continue
            used = timer.time_elapsed()
            share = used / max(used + timer.time_remaining(), 1e-9)
            if trainer.world_size > 1 and used > 0:
                # Clocks differ between processes, but learning rates must not.
                mine = torch.tensor(share, device=self.device)
                share = float(trainer.strategy.reduce(mine, reduce_op="max"))
            shares.append(share)
        if not shares:
            raise InputError("trainer.max_steps: expected steps or trainer.max_time; found neither")
        return min(max(shares), 1.0)

    def log_step(self, step: Step, total: Tensor, terms: Mapping[str, Tensor], **numbers: float) -> Tensor:
        """Log a training step without a synchronisation, and hand it to the guard.

        Args:
            total: its loss, a scalar.
            terms: unweighted terms of the loss by name.
            **numbers: further values by the rest of their tag ``train/``.

        Returns:
            The loss."""
        self.guard.note(step, total)
        numbers |= {
            "learning_rate": self.optimizers().param_groups[0]["lr"],
            "budget": self.used_budget,
            "skipped_steps": float(self.guard.skipped),
        }
        values = {f"loss/{name}": value.detach() for name, value in terms.items()}
        for name, number in numbers.items():
            # Created on the model's device: copying a number there would be a synchronisation.
            is_there = isinstance(number, torch.Tensor)
            values[f"train/{name}"] = number if is_there else torch.full((), number, device=self.device)
        size = len(step.batch.images)
        self.log("loss/total", total.detach(), prog_bar=True, batch_size=size)
        self.log_dict(values, batch_size=size)
        return total

    def configure_gradient_clipping(self, optimizer, gradient_clip_val=None, gradient_clip_algorithm=None):
        """Clip the gradients of all weights, which are already unscaled, to a norm of ``optimizer.clip``,
        and log their norm before. Lightning's arguments are not used.

        Raises:
            InputError: the step is not finite, and the guard does not skip it."""
        self.optimization.drop_frozen_gradients(self, self.used_budget)
        gradients = [parameter.grad for parameter in self.parameters() if parameter.grad is not None]
        norm = nn.utils.get_total_norm(gradients, foreach=True)
        if self.guard.check(self, norm, self._scaler):  # clipping would spread a value that is not finite
            nn.utils.clip_grads_with_norm_(self.parameters(), self.optimization.clip, norm, foreach=True)
            self.log("train/gradient_norm", norm)

    @property
    def _scaler(self) -> torch.amp.GradScaler | None:
        return getattr(self.trainer.precision_plugin, "scaler", None)

    def configure_optimizers(self) -> dict[str, Any]:
        """Build the optimizer of all weights, and its schedule over the used budget."""
        options = getattr(self.model, "options", None)
        captures = getattr(options, "capture", "auto") == "auto"
        optimizer = self.optimization.optimizer(self, self._scaler is None, captures)
        groups = optimizer.param_groups
        self._options = [{k: v for k, v in group.items() if k != "params"} for group in groups]

        def factor(_: int) -> float:
            self.used_budget = self.progress()
            return self.optimization.factor(self.used_budget)

        schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, factor)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Restore the number of skipped steps, and check that Muon does not resume from AdamW's state, or
        vice versa.

        Raises:
            InputError: they differ; the message names ``optimizer.matrix_scale``."""
        self.guard.skipped = checkpoint.get("skipped_steps", 0)
        scale = getattr(self.optimization, "matrix_scale", None)  # a plug-in may lack this option
        for state in checkpoint.get("optimizer_states", ()):
            by_muon = any("orthogonal" in group for group in state["param_groups"])
            expected = f"{'a number' if by_muon else 'null'}, as in {self.trainer.ckpt_path}"
            require(by_muon == (scale is not None), "optimizer.matrix_scale", expected, scale)

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Add the format's version, the configuration, the names of frozen weights and the number of
        skipped steps to a checkpoint: only plain data, so that it loads with
        ``torch.load(weights_only=True)``."""
        checkpoint["format_version"] = FORMAT_VERSION
        checkpoint["config"] = self.config
        checkpoint["skipped_steps"] = self.guard.skipped
        checkpoint["frozen"] = [name for name, p in self.named_parameters() if not p.requires_grad]
        convert_rates_to_numbers(checkpoint)
