"""LightningModule of training: training and validation steps, and logging."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor, nn

from ghgs_lit.execution.predictor import Predictor
from ghgs_lit.execution.step import CapturedStep, Outcome
from ghgs_lit.geometry.unprojection import seen_surfaces
from ghgs_lit.losses import Losses
from ghgs_lit.method.model import GHGS
from ghgs_lit.method.plan.presets import KeptTokens, keep_patches
from ghgs_lit.metrics import FURTHER, MetricsOptions, depth_error_mm, surface_error_mm
from ghgs_lit.training.base import BudgetedModule, image_mean
from ghgs_lit.training.guard import Step
from ghgs_lit.training.optimization import Optimization
from ghgs_lit.types import Batch, Cameras, DepthMaps, Gaussians, Prediction, Rendering

Choice = TypeVar("Choice")
#: Metrics of validations, as the run's protocol defines them; LPIPS only where it is available.
VALIDATED = ("psnr", "psnr_box", "ssim", "lpips", *FURTHER, "psnr_edge")


def sample_budget(budgets: Sequence[Choice], numbers: Sequence[int]) -> Choice:
    """Sample which patches the encoder processes in a training step.

    Args:
        budgets: ``all``: all patches (``skip=none``, ``exact``); ``window``: those of the smallest
            rectangle around the subject (``balanced``); a number: the subject's patches and those at
            most this many patches away (``fast``). A budget listed twice is sampled twice as often.
        numbers: seed; equal numbers give the same budget.

    Returns:
        One of the budgets."""
    # A key of its own, as the same numbers also seed other samples of the step.
    generator = np.random.default_rng(np.random.SeedSequence(numbers, spawn_key=(1,)))
    return budgets[int(generator.integers(len(budgets)))]


def token_budget(model: GHGS, budget: str | int | None) -> AbstractContextManager[None]:
    """Context in which the encoder processes the patches of a budget.

    Args:
        budget: see :func:`sample_budget`; None: as the model is configured."""
    return nullcontext() if budget is None else keep_patches(model.encoder, KeptTokens.of_budget(budget))


def _depth_error(batch: Batch, maps: DepthMaps) -> Tensor:
    """Mean error of predicted depths in mm, over valid pixels of the subjects."""
    valid = batch.masks & maps.valid
    return depth_error_mm(maps.depth.flatten(0, 1), batch.depths.flatten(0, 1), valid.flatten(0, 1))


def _surface_error(batch: Batch, gaussians: Gaussians) -> Tensor:
    """Mean distance between Gaussians and true surfaces in mm, over the batch."""
    errors = []
    for element, surface in enumerate(seen_surfaces(batch)):
        own = gaussians[element]
        errors.append(surface_error_mm(own.means, own.opacities, surface))
    return torch.stack(errors).nanmean()


class GHGSModule(BudgetedModule):
    """Trains a model through a differentiable renderer.

    Args:
        model: see :class:`BudgetedModule`.
        renderer: renders Gaussians from cameras.
        losses: computes the weighted total and the terms by name from a prediction, its rendering and
            the batch. Its weights, if any, are trained with the model's.
        optimization: see :class:`BudgetedModule`.
        config: see :class:`BudgetedModule`.
        token_budgets: budgets from which each training step samples (:func:`sample_budget`); None: as
            the model is configured.

    Attributes:
        metrics: the protocol by which validations measure :data:`VALIDATED`, on the training device;
            initially without LPIPS."""

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
        self.metrics = MetricsOptions(lpips="off").build()
        self.means = nn.ModuleDict({name: image_mean() for name in VALIDATED})
        #: Prepares batches for the model; None: the model is not a :class:`GHGS` and takes them directly.
        self.predictor = Predictor(model) if isinstance(model, GHGS) else None
        self.captured_step = self.predictor and CapturedStep(self.predictor, renderer, losses)

    def forward(self, batch: Batch) -> tuple[Prediction, Rendering]:
        """Predict Gaussians for a batch with targets, and render them from its target cameras."""
        prediction = (self.predictor or self.model)(batch)
        return prediction, self.renderer(prediction.gaussians, batch.targets.cameras)

    def forward_losses(self, step: Step) -> Outcome:
        """Run the forward pass of a step eagerly, with random numbers from its seed."""
        torch.manual_seed(step.seed)
        with token_budget(self.model, step.budget):
            prediction, rendering = self(step.batch)
        return Outcome(*self.losses(prediction, rendering, step.batch), len(prediction.gaussians))

    def _run_captured(self, step: Step) -> Outcome | None:
        """Run the forward pass of a step with CUDA-graph capture; None: it must run eagerly."""
        captured = self.captured_step
        scaler = self._scaler
        if captured is None or not captured.captures(step.batch, scaler is not None):
            return None
        scale = None if scaler is None else scaler.scale(torch.ones((), device=self.device))
        torch.manual_seed(step.seed)
        with token_budget(self.model, step.budget):
            return captured(step.batch, scale)

    def training_step(self, batch: Batch, batch_idx: int) -> Tensor:
        """Run the forward pass of a step on a batch with targets and log its loss, without a
        synchronisation.

        Returns:
            The total loss, a scalar."""
        budget = None
        if self.token_budgets is not None:
            # Equal in all processes, so that none waits for another.
            budget = sample_budget(self.token_budgets, self.step_numbers(batch_idx))
        step = Step(batch, self.step_seed(batch_idx), budget)
        total, terms, gaussians = self._run_captured(step) or self.forward_losses(step)
        return self.log_step(step, total, terms, gaussians=gaussians / len(batch.images))

    def validation_step(self, batch: Batch, batch_idx: int) -> dict[str, Any]:
        """Predict, render and measure a batch with targets.

        Returns:
            ``prediction`` and ``rendering``, for callbacks."""
        prediction, rendering = self(batch)
        size = len(batch.images)
        targets = batch.targets
        known = [name for name in VALIDATED if name != "lpips" or self.metrics.lpips is not None]
        flat = (values.flatten(0, 1) for values in (rendering.image, targets.images, targets.masks))
        depths = None if targets.depths is None else targets.depths.flatten(0, 1)
        for name, values in self.metrics.measure(*flat, known, depths).items():
            self.means[name].update(values)
            is_first = name == VALIDATED[0]
            self.log(f"val/{name}", self.means[name], prog_bar=is_first, on_epoch=True, batch_size=size)
        if batch.depths is not None:
            means = {
                "val/depth_error_mm": _depth_error(batch, prediction.depth_maps),
                "val/surface_mm": _surface_error(batch, prediction.gaussians),
            }
            self.log_dict(means, on_epoch=True, batch_size=size, sync_dist=self.trainer.world_size > 1)
        return {"prediction": prediction, "rendering": rendering}

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Add the shape buckets of captured steps."""
        super().on_save_checkpoint(checkpoint)
        if self.captured_step is not None:
            checkpoint["shape_buckets"] = self.captured_step.state_dict()

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Restore the shape buckets of captured steps."""
        super().on_load_checkpoint(checkpoint)
        if self.captured_step is not None:
            self.captured_step.load_state_dict(checkpoint.get("shape_buckets", ()))
