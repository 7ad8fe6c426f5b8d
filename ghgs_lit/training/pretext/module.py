"""The LightningModule of the pretext stage, and its measure of how well features tell
body parts."""

from collections.abc import Mapping
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torchmetrics import MeanMetric

from ghgs_lit.geometry.rotations import unit
from ghgs_lit.method.encoder.semantic import SemanticBranch, features_of
from ghgs_lit.method.plan.patches import KeptPatches
from ghgs_lit.training.base import BudgetedModule
from ghgs_lit.training.guard import DivergedError
from ghgs_lit.training.optimization import Optimization
from ghgs_lit.training.pretext.labels import part_shares
from ghgs_lit.types import Batch


def neighbor_shows_part(
    features: Float[Tensor, "n c"], parts: Int[Tensor, " n"], views: Int[Tensor, " n"]
) -> Bool[Tensor, " n"]:
    """Whether the most similar patch (cosine) of the other views shows the same part as a patch.

    Args:
        features: of the patches of one person.
        parts: the part that each patch shows.
        views: the view of each patch.

    Returns:
        A value for each patch; false without other views."""
    directions = unit(features)
    cosines = (directions @ directions.T).masked_fill(views[:, None] == views, -torch.inf)
    best, nearest = cosines.max(1) if len(features) else (cosines.new_zeros(0), views)
    return (parts[nearest] == parts) & (best > -torch.inf)


class Pretext(nn.Module):
    """A semantic branch under its name in a model.

    Args:
        branch: to be trained."""

    def __init__(self, branch: SemanticBranch):
        super().__init__()
        self.encoder = nn.ModuleDict({"semantic": branch})

    def forward(self, batch: Batch) -> tuple[Float[Tensor, "N P"], Float[Tensor, "N P"], KeptPatches]:
        """Predict which parts the patches of subjects show.

        Args:
            batch: with true depths and bodies whose parts are known.

        Returns:
            Logarithms of predicted shares, true shares, and their patches."""
        branch = self.encoder["semantic"]
        kept = KeptPatches(branch.subject(batch.masks), batch.images.device)
        shares = part_shares(batch, branch.patch_size)[kept.index]
        return branch.log_shares(batch.images, batch.masks, kept), shares, kept


def cross_entropy(log_shares: Float[Tensor, "N P"], shares: Float[Tensor, "N P"]) -> Tensor:
    """Mean cross-entropy over the patches with a part.

    Args:
        log_shares: logarithms of predicted shares of the parts.
        shares: true shares, all 0 in a patch without a part.

    Returns:
        A value without dimensions; 0 without any patch."""
    return -(shares * log_shares).sum() / shares.any(1).sum().clamp_min(1)


class PretextModule(BudgetedModule):
    """Trains a semantic branch to tell body parts.

    Args:
        model: the branch.
        optimization: as of :class:`BudgetedModule`.
        config: as of :class:`BudgetedModule`."""

    def __init__(self, model: Pretext, optimization: Optimization, config: Mapping[str, Any]):
        super().__init__(model, optimization, config)
        self.part_accuracy = MeanMetric()

    def training_step(self, batch: Batch, batch_idx: int) -> Tensor:
        """Run a step and log its loss; returns it."""
        loss = cross_entropy(*self.model(batch)[:2])
        size = len(batch.images)
        self.log("loss/parts", loss.detach(), prog_bar=True, batch_size=size)
        self.log_numbers(size)
        return loss

    def validation_step(self, batch: Batch, batch_idx: int) -> None:
        """Measure a batch, person by person."""
        log_shares, shares, kept = self.model(batch)
        features = features_of(log_shares)
        part = shares.argmax(1)
        element = kept.image // batch.images.shape[1]
        for b in range(len(batch.images)):
            rows = shares.any(1) & (element == b)
            shown = neighbor_shows_part(features[rows], part[rows], kept.image[rows])
            if len(shown):
                self.part_accuracy.update(shown.float())
        size = len(batch.images)
        self.log("val/part_accuracy", self.part_accuracy, prog_bar=True, on_epoch=True, batch_size=size)
        self.log("val/parts", cross_entropy(log_shares, shares), on_epoch=True, batch_size=size)

    def configure_gradient_clipping(self, optimizer, gradient_clip_val=None, gradient_clip_algorithm=None):
        """Clip to ``optimizer.clip`` and log the norm before.

        Args:
            optimizer, gradient_clip_val, gradient_clip_algorithm: of Lightning; not used.

        Raises:
            DivergedError: the norm is not finite."""
        norm = self.optimization.clip_gradients(self)
        if not norm.isfinite():
            raise DivergedError(
                f"step {self.global_step}: expected a finite gradient; found a norm of {norm}"
            )
        self.log("train/gradient_norm", norm)
