"""Rounds of refinement: Gaussians are compared with the photographs and corrected."""

from ghgs_lit.rounds.coarse import CoarseDepths, coarse_depths, coarse_sizes
from ghgs_lit.rounds.rounds import Rounds, RoundsOptions, State, prediction_of, replaced

__all__ = [
    "CoarseDepths",
    "Rounds",
    "RoundsOptions",
    "State",
    "coarse_depths",
    "coarse_sizes",
    "prediction_of",
    "replaced",
]
