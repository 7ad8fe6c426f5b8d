"""The LightningModule of training: steps and logging around the model."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from ghgs_lit.config import build
from ghgs_lit.errors import require
from ghgs_lit.geometry.unprojection import seen_surfaces
from ghgs_lit.heads.inspection import offsets_at_limit, seen_attributes
from ghgs_lit.losses import Losses
from ghgs_lit.metrics import depth_error_mm, surface_error_mm
from ghgs_lit.metrics.functional import box_of, psnr, ssim
from ghgs_lit.model import GHGS
from ghgs_lit.plan.presets import View, seeing
from ghgs_lit.training.base import BudgetedModule, image_mean
from ghgs_lit.training.guard import Guard, Step
from ghgs_lit.training.optimization import Optimization
from ghgs_lit.types import Batch, Cameras, DepthMaps, Gaussians, Prediction, Rendering
from ghgs_lit.weights.checkpoint import load_strictly, model_state, read_checkpoint


def drawn_budget(budgets: Sequence[str | int], numbers: Sequence[int]) -> str | int:
    """Draw which patches the encoder sees in a training step.

    Args:
        budgets: ``all``: all patches (``skip=none``, ``exact``); ``window``: those of the smallest rectangle
            that holds the subject (``balanced``); a number: the subject's patches and those at most this many
            patches away (``fast``). Budgets that are listed twice are drawn twice as often.
        numbers: seed; equal numbers give the same budget."""
    # A separate key: the same numbers seed the other draws of the step.
    generator = np.random.default_rng(np.random.SeedSequence(numbers, spawn_key=(1,)))
    return budgets[int(generator.integers(len(budgets)))]


def token_budget(model: GHGS, budget: str | int | None) -> AbstractContextManager[None]:
    """Set a budget of :func:`drawn_budget` while the context lasts; None: leave the model unchanged."""
    return nullcontext() if budget is None else seeing(model.encoder, View.of_budget(budget))


def _depth_error(batch: Batch, maps: DepthMaps) -> Tensor:
    valid = batch.masks & maps.valid
    return depth_error_mm(maps.depth.flatten(0, 1), batch.depths.flatten(0, 1), valid.flatten(0, 1))


def _surface_error(batch: Batch, gaussians: Gaussians) -> Tensor:
    errors = []
    for element, surface in enumerate(seen_surfaces(batch)):
        own = gaussians[element]
        errors.append(surface_error_mm(own.means, own.opacities, surface))
    return torch.stack(errors).nanmean()


class GHGSModule(BudgetedModule):
    """Trains a model through a renderer. ``optimization``, ``config``: as of :class:`BudgetedModule`.
    ``token_budgets``: budgets for :func:`drawn_budget` in each training step; None: as configured.
    ``lpips``: of images and targets [n, 3, h, w], n values, measured in validations; None: not measured."""

    lpips: Callable[[Tensor, Tensor], Tensor] | None = None

    def __init__(
        self,
        model: nn.Module,
        renderer: Callable[[Gaussians, Cameras], Rendering],
        losses: Losses,
        optimization: Optimization,
        config: Mapping[str, Any] | None = None,
        token_budgets: Sequence[str | int] | None = None,
    ):
        super().__init__(model, optimization, config)
        self.renderer = renderer
        self.losses = losses
        self.token_budgets = token_budgets
        self.guard = Guard(optimization.skip_nonfinite)
        self.val_psnr, self.val_psnr_box = image_mean(), image_mean()
        model.keeps_drafts = True  # validation measures each round

    @classmethod
    def load_from_checkpoint(
        cls, checkpoint_path: str | Path, map_location: Any = None, **parts: Any
    ) -> "GHGSModule":
        """The module of a checkpoint of ``ghgs train`` or of any Trainer. ``parts``: ``renderer``, ``losses``
        and ``optimization`` in place of those of the configuration. InputError: the checkpoint cannot be
        used, or a part is neither configured nor given."""
        checkpoint = read_checkpoint(checkpoint_path)
        config = checkpoint["config"]
        for name, group in {"losses": "loss", "optimization": "optimizer", "renderer": "renderer"}.items():
            if name in parts:
                continue
            place = f"{checkpoint_path}: config.{group}"
            require(group in config, place, f"options of it, or {name}=...", "nothing")
            parts[name] = build(config[group], group)
            if state := model_state(checkpoint, f"{name}."):  # a loss with weights of its own
                load_strictly(parts[name], state, checkpoint_path)
        model = GHGS.from_checkpoint(checkpoint_path, map_location or "cpu")
        return cls(model.train(), config=config, **parts)

    def forward(self, batch: Batch) -> tuple[Prediction, Rendering]:
        """The prediction for a batch, and its Gaussians rendered from the batch's target cameras."""
        prediction = self.model(batch)
        return prediction, self.renderer(prediction.gaussians, batch.targets.cameras)

    def forward_losses(self, step: Step) -> tuple[Prediction, Tensor, dict[str, Tensor]]:
        """The prediction of a step, its loss and the loss's terms, with the random numbers of its seed."""
        torch.manual_seed(step.seed)
        with token_budget(self.model, step.budget):
            prediction, rendering = self(step.batch)
        total, values = self.losses(prediction, rendering, step.batch)
        return prediction, total, values

    def _step(self, batch: Batch, batch_idx: int) -> Step:
        device = self.device.type
        autocast = torch.get_autocast_dtype(device) if torch.is_autocast_enabled(device) else None
        budget = None
        if self.token_budgets is not None:  # the same in all processes, so that none waits for another
            part = batch_idx % self.trainer.accumulate_grad_batches
            numbers = [self.config.get("seed", 0), self.global_step, part]
            budget = drawn_budget(self.token_budgets, numbers)
        return Step(batch, self.step_seed(batch_idx), budget, autocast)

    def training_step(self, batch: Batch, batch_idx: int) -> Tensor:
        step = self._step(batch, batch_idx)
        prediction, total, values = self.forward_losses(step)
        self.guard.note(step, total)
        size = len(batch.images)
        self.log("loss/total", total.detach(), prog_bar=True, batch_size=size)
        self.log_dict({f"loss/{name}": v.detach() for name, v in values.items()}, batch_size=size)
        numbers = {
            "learning_rate": self.optimizers().param_groups[0]["lr"],
            "budget": self.used_budget,
            "skipped_steps": float(self.guard.skipped),
            "gaussians": len(prediction.gaussians) / size,
        }
        # Made where the model is: a number that is copied to a GPU makes the host wait.
        filled = {f"train/{n}": torch.full((), value, device=self.device) for n, value in numbers.items()}
        self.log_dict(filled, batch_size=size)
        return total

    def validation_step(self, batch: Batch, batch_idx: int) -> dict[str, Any]:
        head = getattr(self.model, "gaussian_head", None)
        with seen_attributes(head) as seen:
            prediction, rendering = self(batch)
        image, target = rendering.image.flatten(0, 1).clamp(0, 1), batch.targets.images.flatten(0, 1)
        size, box = len(batch.images), box_of(batch.targets.masks.flatten(0, 1))
        self.val_psnr.update(psnr(image, target))
        self.val_psnr_box.update(psnr(image, target, box))
        self.log("val/psnr", self.val_psnr, prog_bar=True, on_epoch=True, batch_size=size)
        self.log("val/psnr_box", self.val_psnr_box, on_epoch=True, batch_size=size)
        means = {"val/ssim": ssim(image, target).mean(), **self._rounds(batch, prediction)}
        if seen and head.has_offset_limit:
            means["val/offsets_at_limit"] = offsets_at_limit(seen[-1])
        if self.lpips is not None:
            means["val/lpips"] = self.lpips(image, target).mean()
        if batch.depths is not None:
            means["val/depth_error_mm"] = _depth_error(batch, prediction.depth_maps)
            means["val/surface_mm"] = _surface_error(batch, prediction.gaussians)
        self.log_dict(means, on_epoch=True, batch_size=size, sync_dist=self.trainer.world_size > 1)
        return {"prediction": prediction, "rendering": rendering}

    def _rounds(self, batch: Batch, prediction: Prediction) -> dict[str, Tensor]:
        found = {}
        for number, draft in enumerate(prediction.drafts):
            image = self.renderer(draft, batch.targets.cameras).image.clamp(0, 1).flatten(0, 1)
            found[f"val/psnr_before_round_{number + 1}"] = psnr(
                image, batch.targets.images.flatten(0, 1)
            ).mean()
            if batch.depths is not None:
                error = _depth_error(batch, prediction.rounds[number])
                found[f"val/depth_error_mm_before_round_{number + 1}"] = error
        return found

    def configure_gradient_clipping(self, optimizer, gradient_clip_val=None, gradient_clip_algorithm=None):
        """Clip to ``optimizer.clip`` and log the norm before; the arguments are not used. Gradients are
        already unscaled. After an overflow, a scaler of the loss skips the step and halves its factor; the
        guard handles losses that are not finite, and gradients that overflow without a factor. DivergedError:
        the guard does not skip the step."""
        self.optimization.drop_frozen_gradients(self.model, self.used_budget)
        norm = nn.utils.clip_grad_norm_(self.model.parameters(), self.optimization.clip, foreach=True)
        loss_holds, norm_holds = self.guard.is_finite(self.trainer, norm)
        if loss_holds and norm_holds:
            self.log("train/gradient_norm", norm)
        else:
            scale = 1.0 if self._scaler is None else self._scaler.get_scale()
            if not loss_holds or scale <= 1:
                self.guard.refuse(self, scale)
                return
        self.guard.accept()

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        super().on_save_checkpoint(checkpoint)
        checkpoint["skipped_steps"] = self.guard.skipped

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        self.guard.skipped = checkpoint.get("skipped_steps", 0)
