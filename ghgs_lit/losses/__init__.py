"""Training losses."""

from ghgs_lit.losses.losses import Losses

__all__ = ["Losses"]
