"""Base of the LightningModules of this package: a schedule over the run's budget,
plain checkpoints."""

from collections.abc import Mapping
from typing import Any

import lightning.pytorch as L
import numpy as np
import torch
from lightning.pytorch.callbacks import Timer
from torch import nn
from torchmetrics import MeanMetric

from ghgs_lit.errors import InputError, require
from ghgs_lit.runtime.watching import time_mark
from ghgs_lit.training.optimization import Optimization, hold_rates, plain_rates
from ghgs_lit.types import Batch
from ghgs_lit.weights.checkpoint import FORMAT_VERSION


def image_mean() -> MeanMetric:
    """A mean over the images of a validation, in float64; nan is left out."""
    return MeanMetric(nan_strategy="ignore").set_dtype(torch.float64)


class BudgetedModule(L.LightningModule):
    """A module whose learning rate follows the used share of the run's budget.

    Args:
        model: trained. All other parts with weights, such as a loss, are trained, clipped, frozen
            and saved with it; checkpoints hold the model's tensors under ``model.``, others under
            the part's name.
        optimization: options of the optimizer and its schedule.
        config: the run's full configuration as plain data, of which ``seed`` is read; checkpoints
            contain it together with the model's own. None: only that of the model.

    Attributes:
        ready: time mark of the end of the last step and all that followed,
            from where a step waits for data.
        used_budget: used share of the run's budget in [0, 1], as of the last step."""

    def __init__(self, model: nn.Module, optimization: Optimization, config: Mapping[str, Any] | None):
        super().__init__()
        self.model = model
        self.optimization = optimization
        self.config = {**getattr(model, "config", {}), **(config or {})}
        self.used_budget = 0.0
        self.ready = time_mark(torch.device("cpu"))

    def transfer_batch_to_device(self, batch: Batch, device: torch.device, dataloader_idx: int) -> Batch:
        """Copy a batch without a synchronisation where its memory is pinned.

        Args:
            batch: of the data.
            device: of the training.
            dataloader_idx: not used.

        Returns:
            The batch there."""
        # Lightning copies unknown structures one tensor at a time, and waits for each.
        return batch.to(device, non_blocking=device.type != "cpu")

    def on_train_start(self) -> None:
        """Continue at the budget's used share, with this run's options of the optimizer."""
        self.ready = time_mark(self.device)
        # After a restart the scheduler updates it only after a step.
        self.used_budget = self.progress()
        # This run's options of the optimizer replace those of a resumed checkpoint.
        optimizer = self.optimizers()
        schedule = self.lr_schedulers()
        for number, (group, option) in enumerate(zip(optimizer.param_groups, self._options, strict=True)):
            # The rate itself includes the schedule's factor of the next step.
            rate = group["lr"] * option["lr"] / schedule.base_lrs[number]
            group.update(option, lr=rate, initial_lr=option["lr"])
            schedule.base_lrs[number] = option["lr"]
        hold_rates(optimizer)

    def on_train_batch_start(self, *args: Any) -> None:
        """Correct Lightning's count of steps."""
        # Lightning's own count is one ahead in a run that goes on from the end of another session.
        self.trainer.fit_loop.epoch_loop._batches_that_stepped = self.global_step

    def step_seed(self, batch_idx: int) -> int:
        """Seed of the random numbers of this step: the same after an interruption, and in all
        processes, so that none waits for one that has sampled more rounds.

        Args:
            batch_idx: of Lightning, which distinguishes the parts of an accumulated step.

        Returns:
            A number of 32 bits, of the run's seed, the step and the part."""
        return int(np.random.SeedSequence(self.step_numbers(batch_idx)).generate_state(1)[0])

    def step_numbers(self, batch_idx: int) -> list[int]:
        """Seeds all randomness of the step: seed of the run, step, and part of an accumulated step."""
        part = batch_idx % self.trainer.accumulate_grad_batches
        return [self.config.get("seed", 0), self.global_step, part]

    def class_numbers(self, batch_idx: int) -> list[int] | None:
        """The same for what ``data.class_steps`` consecutive batches share; None: they share nothing."""
        steps = (self.config.get("data") or {}).get("class_steps", 1)
        seed, step, part = self.step_numbers(batch_idx)
        return None if steps == 1 else [seed, (step * self.trainer.accumulate_grad_batches + part) // steps]

    def progress(self) -> float:
        """Used share of the budget.

        Returns:
            The share in [0, 1] of steps or of time, whichever is larger; the same in all processes.

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
                # Clocks of processes differ, but learning rates must not.
                mine = torch.tensor(share, device=self.device)
                share = float(trainer.strategy.reduce(mine, reduce_op="max"))
            shares.append(share)
        if not shares:
            raise InputError("trainer.max_steps: expected steps or trainer.max_time; found neither")
        return min(max(shares), 1.0)

    def log_numbers(self, size: int, **numbers: float) -> None:
        """Log the learning rate, the used budget and further numbers of a step under ``train/``.

        Args:
            size: elements of the batch.
            **numbers: by name."""
        numbers = {
            "learning_rate": self.optimizers().param_groups[0]["lr"],
            "budget": self.used_budget,
            **numbers,
        }
        values = {}
        for name, number in numbers.items():
            # Made where the model is: a number that is copied to a GPU makes the host wait.
            is_there = isinstance(number, torch.Tensor)
            values[f"train/{name}"] = number if is_there else torch.full((), number, device=self.device)
        self.log_dict(values, batch_size=size)

    @property
    def _scaler(self) -> torch.amp.GradScaler | None:
        return getattr(self.trainer.precision_plugin, "scaler", None)

    def configure_optimizers(self) -> dict[str, Any]:
        """The optimizer of all weights and its schedule, which follows the used budget."""
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

    def on_train_batch_end(self, *args: Any) -> None:
        """Note when the step ended."""
        self.ready = time_mark(self.device)  # called after all callbacks

    def on_validation_end(self) -> None:
        """The next step does not wait for data as long as the validation took."""
        self.on_train_batch_end()

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Check that Muon does not resume from AdamW's state, or vice versa.

        Args:
            checkpoint: of Lightning.

        Raises:
            InputError: names ``optimizer.matrix_scale``."""
        scale = getattr(self.optimization, "matrix_scale", None)  # a plug-in's may have none
        for state in checkpoint.get("optimizer_states", ()):
            by_muon = any("orthogonal" in group for group in state["param_groups"])
            expected = f"{'a number' if by_muon else 'null'}, as in {self.trainer.ckpt_path}"
            require(by_muon == (scale is not None), "optimizer.matrix_scale", expected, scale)

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Add plain data only, so that the file loads with ``torch.load(weights_only=True)``.

        Args:
            checkpoint: of Lightning; gets the configuration and the names of weights that are
                not trained."""
        checkpoint["format_version"] = FORMAT_VERSION
        checkpoint["config"] = self.config
        checkpoint["frozen"] = [name for name, p in self.named_parameters() if not p.requires_grad]
        plain_rates(checkpoint)
