"""Training: LightningModules, optimization, callbacks and loggers."""

from ghgs_lit.training.module import GHGSModule
from ghgs_lit.training.optimization import Optimization

__all__ = ["GHGSModule", "Optimization"]
