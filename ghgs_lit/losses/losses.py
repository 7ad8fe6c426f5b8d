"""The weighted sum of the loss terms of a configuration."""

from collections.abc import Mapping
from functools import partial

from torch import Tensor

from ghgs_lit.errors import choice, require
from ghgs_lit.geometry.chamfer import KINDS
from ghgs_lit.losses import terms
from ghgs_lit.types import Batch, Prediction, Rendering

DEPTH_UNITS = ("metres", "relative")


class Losses:
    """``losses(prediction, rendering, batch)`` gives the weighted total and each unweighted term by name.

    Args:
        weights: of ``render_l1``, ``render_ssim``, ``chamfer`` and ``depth``; a term of weight 0 is not
            computed.
        chamfer: penalty of a distance: ``squared`` (the paper), ``huber`` or ``truncated``; the last two
            differ from the first beyond ``chamfer_scale``.
        chamfer_scale: metres.
        chamfer_points: how many points of each set are matched in a step, chosen at random; None for all.
        depth: unit of the depth error: ``metres``, or ``relative`` to the true depth.
    """

    def __init__(
        self,
        weights: Mapping[str, float],
        chamfer: str = "squared",
        chamfer_scale: float = 0.1,
        chamfer_points: int | None = None,
        depth: str = "metres",
    ):
        choice("loss.chamfer", chamfer, KINDS)
        choice("loss.depth", depth, DEPTH_UNITS)
        require(chamfer_scale > 0, "loss.chamfer_scale", "a positive number of metres", chamfer_scale)
        require(
            chamfer_points is None or chamfer_points > 0,
            "loss.chamfer_points",
            "null or a positive number",
            chamfer_points,
        )
        self.functions = {
            "render_l1": terms.render_l1,
            "render_ssim": terms.render_ssim,
            "chamfer": partial(terms.chamfer, kind=chamfer, scale=chamfer_scale, points=chamfer_points),
            "depth": partial(terms.depth, relative=depth == "relative"),
        }
        for name, weight in weights.items():
            choice("loss.weights", name, tuple(self.functions))
            require(weight >= 0, f"loss.weights.{name}", "a number of at least 0", weight)
        self.weights = {name: float(weight) for name, weight in weights.items() if weight > 0}
        require(bool(self.weights), "loss.weights", "at least one weight above 0", dict(weights))

    @property
    def reads_depths(self) -> bool:
        """Whether a term compares with true depths."""
        return "depth" in self.weights

    def __call__(
        self, prediction: Prediction, rendering: Rendering, batch: Batch
    ) -> tuple[Tensor, dict[str, Tensor]]:
        values = {name: self.functions[name](prediction, rendering, batch) for name in self.weights}
        total = sum(self.weights[name] * value for name, value in values.items())
        return total, values
