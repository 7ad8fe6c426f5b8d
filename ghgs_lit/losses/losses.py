"""The weighted sum of the loss terms of a configuration."""

from collections.abc import Callable
from functools import cached_property, partial
from typing import Any

from pydantic import ConfigDict, model_validator
from torch import Tensor

from ghgs_lit.config.options import Amount, Count, Options
from ghgs_lit.config.registry import TERM, class_of
from ghgs_lit.errors import InputError, require
from ghgs_lit.types import Batch, Prediction, Rendering


class LossWeights(Options):
    """Weight of each term by name; a term of weight 0 is not computed. Terms that a plug-in registers
    have a key, too."""

    model_config = ConfigDict(extra="allow")
    group = "loss.weights"
    render_l1: Amount = 0.8
    """Mean |render - target| (paper: 0.8)."""
    render_ssim: Amount = 0.2
    """1 - SSIM of render and target (paper: 0.2)."""
    chamfer: Amount = 1.0
    """Chamfer distance of unprojected pixels and body vertices in m^2 (paper: 1.0); the data must have
    body vertices."""
    depth: Amount = 0.0
    """|z - true z| in metres, summed over rounds (not in the paper); the data must have depth maps."""
    silhouette: Amount = 0.0
    """Mean |alpha - mask| of the target views (not in the paper)."""
    lpips: Amount = 0.0
    """LPIPS of render and target (not in the paper); needs the extra lpips."""


class Losses(Options):
    """The weighted sum of the terms whose weight is above 0."""

    group = "loss"
    weights: LossWeights = LossWeights()
    """Weight of each term by name; register("term", name) adds a term."""
    chamfer_points: Count | None = None
    """Number of points of each set, sampled at random in each step, that the Chamfer term matches;
    null: all (paper)."""

    @cached_property
    def terms(self) -> dict[str, Callable[[Prediction, Rendering, Batch], Tensor]]:
        """Terms with a weight above 0, by name.

        Raises:
            InputError: a term is not registered, or its package or weights are missing."""
        terms: dict[str, Any] = {}
        for name, weight in self.weights:
            term = class_of(TERM, name, f"weights.{name}")
            require(type(weight) in (int, float) and weight >= 0, f"weights.{name}", "a number >= 0", weight)
            if weight > 0:
                terms[name] = term() if isinstance(term, type) else term
        if "chamfer" in terms:
            terms["chamfer"] = partial(terms["chamfer"], points=self.chamfer_points)
        return terms

    @model_validator(mode="after")
    def _has_a_term(self) -> "Losses":
        if not self.terms:
            raise InputError("weights: expected at least one weight above 0; found none")
        return self

    @property
    def reads_depths(self) -> bool:
        """Whether a term may read true depths; a plug-in's term is assumed to."""
        return self.weights.depth > 0 or bool(self.weights.model_extra)

    def __call__(
        self, prediction: Prediction, rendering: Rendering, batch: Batch
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Compute the loss of a training step.

        Args:
            prediction: of the model for the batch.
            rendering: its Gaussians rendered from the target cameras.
            batch: with targets, and body vertices or depth maps where a term reads them.

        Returns:
            The weighted sum, and each unweighted term by name; all scalars.

        Raises:
            InputError: the data lacks body vertices or depth maps that a term reads."""
        values = {name: term(prediction, rendering, batch) for name, term in self.terms.items()}
        total = sum(getattr(self.weights, name) * value for name, value in values.items())
        return total, values
