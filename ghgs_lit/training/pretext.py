"""Pretext training of the semantic branch: body parts as labels of patches, the LightningModule, and a
metric of how well features distinguish parts."""

from collections.abc import Mapping
from functools import cache
from typing import Any, ClassVar

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torchmetrics import MeanMetric

from ghgs_lit.config import registry
from ghgs_lit.config.options import Options
from ghgs_lit.errors import require
from ghgs_lit.geometry.chamfer import nearest
from ghgs_lit.geometry.projection import unproject_maps
from ghgs_lit.geometry.rotations import unit
from ghgs_lit.method.encoder.semantic import SemanticBranch, features_of
from ghgs_lit.method.plan.patches import KeptPatches
from ghgs_lit.training.base import BudgetedModule
from ghgs_lit.training.guard import Step
from ghgs_lit.training.optimization import Optimization
from ghgs_lit.types import Batch

#: Body parts with which patches are labelled.
PARTS = (
    "head", "chest", "abdomen", "hips",
    "left upper arm", "right upper arm", "left forearm", "right forearm", "left hand", "right hand",
    "left thigh", "right thigh", "left shin", "right shin", "left foot", "right foot",
)  # fmt: skip


class BodyParts(Options):
    """Body parts of the vertices of a body model. Plug-ins register subclasses as kinds of ``parts``."""

    vertices: ClassVar[int]
    """Number of vertices, which identifies the body model."""

    def of_vertices(self) -> np.ndarray:
        """Return the part of each vertex, [n] indices into :data:`PARTS`."""
        raise NotImplementedError


@cache
def _vertex_parts(vertices: int) -> np.ndarray | None:
    """Parts of the body model with this number of vertices; None: no plug-in provides it."""
    for kind in registry.kinds_of(registry.PARTS):
        body = registry.class_of(registry.PARTS, kind, registry.PARTS)
        if body.vertices == vertices:
            return body().of_vertices()
    return None


def parts_of_points(points: Float[Tensor, "n 3"], vertices: Float[Tensor, "m 3"]) -> Int[Tensor, " n"]:
    """Label world points on clothes, hair or skin with the part of the nearest vertex of the body.

    Args:
        points: world points, in the unit of ``vertices``.
        vertices: all vertices of the posed body.

    Returns:
        Indices into :data:`PARTS`.

    Raises:
        InputError: no plug-in provides the parts of a body with this number of vertices.
    """
    parts = _vertex_parts(len(vertices))
    expected = "those of a body whose parts are known, as of a built-in person (data=synthetic)"
    require(parts is not None, "vertices of the body", expected, len(vertices))
    return torch.from_numpy(parts[nearest(points, vertices).cpu().numpy()]).to(points.device)


def part_shares(batch: Batch, patch_size: int) -> Float[Tensor, "n P"]:
    """Shares of :data:`PARTS` among the subject's pixels of each patch.

    Args:
        batch: a batch with true depths and with vertices of bodies whose parts are known; image sides
            are divisible by the patch size.
        patch_size: side of a patch in pixels.

    Returns:
        Shares of each patch, ordered by image, row and column; 0 in patches without the subject.

    Raises:
        InputError: the batch has no depths, no bodies, or bodies whose parts are unknown."""
    require(batch.depths is not None, "data", "true depths, which the labels are made from", "none")
    require(batch.body_vertices is not None, "data", "people with bodies, as data=synthetic", "none")
    b, v, height, width = batch.depths.shape
    valid = batch.masks & (batch.depths > 0)
    points = unproject_maps(batch.depths, batch.cameras)
    parts = []
    for element, body in enumerate(batch.body_vertices):
        parts.append(parts_of_points(points[element][valid[element]], body))
    labels = torch.cat(parts)
    grid = (b, v, height // patch_size, width // patch_size)
    numbers = torch.arange(grid[0] * grid[1] * grid[2] * grid[3], device=labels.device)
    patch = F.interpolate(numbers.view(grid).double(), scale_factor=patch_size).long()[valid]
    counts = torch.bincount(patch * len(PARTS) + labels, minlength=len(numbers) * len(PARTS))
    counts = counts.view(-1, len(PARTS)).float()
    return counts / counts.sum(1, keepdim=True).clamp_min(1)


def neighbor_shows_part(
    features: Float[Tensor, "n c"], parts: Int[Tensor, " n"], views: Int[Tensor, " n"]
) -> Bool[Tensor, " n"]:
    """Whether the most similar patch of another view (by cosine similarity) shows the same part.

    Args:
        features: features of the patches of one person.
        parts: part of each patch.
        views: view of each patch.

    Returns:
        A value for each patch; False if there are no other views."""
    directions = unit(features)
    cosines = (directions @ directions.T).masked_fill(views[:, None] == views, -torch.inf)
    best, nearest = cosines.max(1) if len(features) else (cosines.new_zeros(0), views)
    return (parts[nearest] == parts) & (best > -torch.inf)


class Pretext(nn.Module):
    """Wrapper of a semantic branch that gives its weights the same names as in a full model."""

    def __init__(self, branch: SemanticBranch):
        super().__init__()
        self.encoder = nn.ModuleDict({"semantic": branch})

    def forward(self, batch: Batch) -> tuple[Float[Tensor, "N P"], Float[Tensor, "N P"], KeptPatches]:
        """Predict the shares of body parts in the foreground patches.

        Args:
            batch: see :func:`part_shares`.

        Returns:
            Logarithms of predicted shares, true shares, and their patches."""
        branch = self.encoder["semantic"]
        kept = KeptPatches(branch.subject(batch.masks), batch.images.device)
        shares = part_shares(batch, branch.patch_size)[kept.index]
        return branch.log_shares(batch.images, batch.masks, kept), shares, kept


def cross_entropy(log_shares: Float[Tensor, "N P"], shares: Float[Tensor, "N P"]) -> Tensor:
    """Mean cross-entropy over the patches that show a part.

    Args:
        log_shares: logarithms of the predicted shares.
        shares: true shares, all 0 in a patch without a part.

    Returns:
        A scalar; 0 if no patch shows a part."""
    return -(shares * log_shares).sum() / shares.any(1).sum().clamp_min(1)


class PretextModule(BudgetedModule):
    """Trains a semantic branch to distinguish body parts; arguments as for :class:`BudgetedModule`."""

    def __init__(self, model: Pretext, optimization: Optimization, config: Mapping[str, Any]):
        super().__init__(model, optimization, config)
        self.part_accuracy = MeanMetric()

    def forward_losses(self, step: Step) -> tuple[Tensor, dict[str, Tensor]]:
        """Compute the loss of a step, also by its name."""
        loss = cross_entropy(*self.model(step.batch)[:2])
        return loss, {"parts": loss}

    def training_step(self, batch: Batch, batch_idx: int) -> Tensor:
        """Compute, log and return the loss."""
        step = Step(batch, self.step_seed(batch_idx))
        return self.log_step(step, *self.forward_losses(step))

    def validation_step(self, batch: Batch, batch_idx: int) -> None:
        """Measure the accuracy of nearest patches per person, and the loss."""
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
