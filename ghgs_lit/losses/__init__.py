"""Training losses."""

from ghgs_lit.losses.losses import Losses, LossWeights

__all__ = ["LossWeights", "Losses"]
