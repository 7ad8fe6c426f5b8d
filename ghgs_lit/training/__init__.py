"""Training: the LightningModule, its optimization and its callbacks."""

from ghgs_lit.training.module import DivergedError, GHGSModule
from ghgs_lit.training.optimization import Optimization

__all__ = ["DivergedError", "GHGSModule", "Optimization"]
