"""Optimisation of predicted Gaussians towards the input images.

A few steps suffice, and every change is bounded, so that parts that no input view shows stay as
predicted."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ghgs_lit.errors import require
from ghgs_lit.geometry.masks import coverage, on_black
from ghgs_lit.geometry.precision import exact
from ghgs_lit.geometry.projection import world_to_camera
from ghgs_lit.metrics.functional import ssim
from ghgs_lit.types import Batch, Cameras, Gaussians, Rendering

Renderer = Callable[..., Rendering]
Seen = tuple[Tensor, Tensor, Cameras]  #: Input images on black, silhouettes and cameras


@dataclass(frozen=True)
class Change:
    """Bound of a value's change, and Adam's learning rate."""

    limit: float
    rate: float


#: Changes so small that parts that no input view shows stay as predicted.
NEAR = {
    "means": Change(1.0, 0.03),
    "scales": Change(1.0, 0.06),
    "opacities": Change(2.0, 0.04),
    "colors": Change(0.05, 0.001),
}
#: Weights of L1, 1 - SSIM and L1 of the silhouette.
Weights = tuple[float, float, float]
#: SSIM gains nothing here, and would take up to four fifths of the time.
WEIGHTS: Weights = (1.0, 0.0, 0.3)


class Descent:
    """Bounded changes of Gaussians, initially 0, and their optimiser.

    Args:
        gaussians: predicted from ``batch``, each at a pixel of an input.
        batch: may be None if ``means`` do not change.
        changes: as for :class:`Refinement`.

    Raises:
        InputError: ``means`` change, but the Gaussians have no pixels.
    """

    def __init__(self, gaussians: Gaussians, batch: Batch | None, changes: Mapping[str, Change]):
        self.start = gaussians.detach()
        self.changes = changes
        if "means" in changes:
            require(gaussians.image is not None, "refine", "Gaussians of the inputs' pixels", "others")
            self._footprint = _footprints(self.start, batch)
        self._raw = {n: torch.zeros_like(getattr(self.start, n), requires_grad=True) for n in changes}
        # A negligible epsilon: the loss is a mean, whose gradients shrink with image and batch size.
        groups = [{"params": [self._raw[name]], "lr": change.rate} for name, change in changes.items()]
        self._optimizer = torch.optim.Adam(groups, betas=(0.9, 0.95), eps=1e-15)

    @property
    @torch.no_grad()
    def gaussians(self) -> Gaussians:
        """The current Gaussians, without a gradient."""
        return self._apply_changes()

    def step(self, renderer: Renderer, seen: Seen, weights: Weights) -> Rendering:
        """Take one optimiser step, and return the renders before it.

        Args:
            renderer: renders the input views, with gradients.
            seen: from :func:`find_visible`.
            weights: weights of L1, 1 - SSIM and L1 of the silhouette.
        """
        with exact(self.start.means.device.type), torch.enable_grad():
            drawn = renderer(self._apply_changes(), seen[2], background=0.0)
            self._optimizer.zero_grad()
            _loss(drawn, *seen[:2], weights).backward()
            self._optimizer.step()
        return drawn

    def _apply_changes(self) -> Gaussians:
        start = self.start
        change = {n: c.limit * torch.tanh(self._raw[n] / c.limit) for n, c in self.changes.items()}
        changed = {name: getattr(start, name) + value for name, value in change.items()}
        if "means" in change:
            changed["means"] = start.means + self._footprint * change["means"]
        if "scales" in change:
            changed["scales"] = start.scales * change["scales"].exp()
        if "opacities" in change:
            # No step could leave an opacity of exactly 0 or 1.
            logit = torch.logit(start.opacities.clamp(1e-4, 1 - 1e-4))
            changed["opacities"] = torch.sigmoid(logit + change["opacities"])
        return replace(start, **changed)


class Refinement:
    """Refine Gaussians towards the input images: ``refinement(gaussians, batch) -> Gaussians``.

    Args:
        steps: number of optimiser steps, 1 or more.
        renderer: renders the input views, with gradients.
        changes: bounds by field: means in footprints of their pixels, scales as logarithms,
            opacities as logits, quaternions, colours. Other fields stay.
        weights: weights of L1, 1 - SSIM and L1 of the silhouette.

    Raises:
        InputError: ``steps`` is below 1.
    """

    def __init__(
        self,
        steps: int,
        renderer: Renderer,
        changes: Mapping[str, Change] = NEAR,
        weights: Weights = WEIGHTS,
    ):
        require(steps >= 1, "refine", "1 or more steps", steps)
        self.steps = steps
        self.renderer = renderer
        self.changes = changes
        self.weights = weights

    def __call__(self, gaussians: Gaussians, batch: Batch) -> Gaussians:
        """Refine Gaussians predicted from ``batch``; returns them in the same order, without a gradient.

        Raises:
            InputError: the Gaussians do not belong to pixels of ``batch``.
        """
        seen = find_visible(batch)
        search = Descent(gaussians, batch, self.changes)
        for _ in range(self.steps):
            search.step(self.renderer, seen, self.weights)
        return search.gaussians


def find_visible(batch: Batch) -> Seen:
    """Input images on black, silhouettes [B, V, 1, H, W] and cameras."""
    return on_black(batch), coverage(batch)[:, :, None], batch.cameras


def _footprints(gaussians: Gaussians, batch: Batch) -> Tensor:
    """Size [N, 1] of a pixel at each Gaussian's depth in its image, in the unit of the world."""
    extrinsics = batch.cameras.extrinsics.flatten(0, 1)
    intrinsics = batch.cameras.intrinsics.flatten(0, 1)
    image = gaussians.image
    dtype = gaussians.means.dtype
    depth = world_to_camera(gaussians.means, extrinsics.to(dtype)[image])[:, 2]
    focal = intrinsics.to(dtype).diagonal(dim1=-2, dim2=-1)[:, :2].prod(-1).sqrt()[image]
    return (depth / focal)[:, None]


def _loss(drawn: Rendering, photographs: Tensor, silhouettes: Tensor, weights: Weights) -> Tensor:
    """Weighted sum of the terms; SSIM is not computed if its weight is 0."""
    l1, dissimilar, outline = weights
    loss = l1 * (drawn.image - photographs).abs().mean() + outline * (drawn.alpha - silhouettes).abs().mean()
    if not dissimilar:
        return loss
    structure = ssim(drawn.image.flatten(0, 1), photographs.flatten(0, 1), padding="valid").mean()
    return loss + dissimilar * (1 - structure)
