"""The weighted sum of the loss terms of a configuration."""

from pydantic import model_validator
from torch import Tensor

from ghgs_lit.config.options import Amount, Count, Options
from ghgs_lit.errors import InputError
from ghgs_lit.losses import terms
from ghgs_lit.types import Batch, Prediction, Rendering


class LossWeights(Options):
    """Weight of each term; a term of weight 0 is not computed."""

    group = "loss.weights"
    render_l1: Amount = 0.8
    """Mean |render - photograph| (paper: 0.8)."""
    render_ssim: Amount = 0.2
    """1 - SSIM of render and photograph (paper: 0.2)."""
    chamfer: Amount = 1.0
    """Unprojected pixels to body vertices, m^2 (paper: 1.0); the data must have body vertices."""
    depth: Amount = 0.0
    """|z - true z| in metres, the sum over rounds (not in the paper);
    the data must have depth maps."""

    silhouette: Amount = 0.0
    """Mean |alpha - mask| of the target views (not in the paper)."""

    @property
    def used(self) -> dict[str, float]:
        """The weights above 0 by name."""
        return {name: weight for name, weight in self if weight > 0}


class Losses(Options):
    """The weighted sum of the terms of :mod:`ghgs_lit.losses.terms` whose weight is above 0."""

    group = "loss"
    weights: LossWeights = LossWeights()
    """Weights of the terms."""
    chamfer_points: Count | None = None
    """Points of each set that the Chamfer term matches in a step, chosen at random;
    null: all (paper)."""

    @model_validator(mode="after")
    def _has_a_term(self) -> "Losses":
        if not self.weights.used:
            raise InputError("weights: expected at least one weight above 0; found none")
        return self

    @property
    def reads_depths(self) -> bool:
        """Whether a term compares with true depths."""
        return self.weights.depth > 0

    def __call__(
        self, prediction: Prediction, rendering: Rendering, batch: Batch
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """The loss of a training step.

        Args:
            prediction: of the model for the batch.
            rendering: its Gaussians from the target cameras.
            batch: with targets, and body vertices or depth maps where a term reads them.

        Returns:
            The weighted total, and each term before its weight by name, all without dimensions.

        Raises:
            InputError: the data has no body vertices or depth maps for a term that reads them."""
        values = {name: self._term(name, prediction, rendering, batch) for name in self.weights.used}
        total = sum(self.weights.used[name] * value for name, value in values.items())
        return total, values

    def _term(self, name: str, prediction: Prediction, rendering: Rendering, batch: Batch) -> Tensor:
        """A term before its weight.

        Args:
            name: a field of :class:`LossWeights`.
            prediction: of the model for the batch.
            rendering: its Gaussians from the target cameras.
            batch: with what the term reads.
        """
        if name == "chamfer":
            return terms.chamfer(prediction, rendering, batch, self.chamfer_points)
        return getattr(terms, name)(prediction, rendering, batch)
