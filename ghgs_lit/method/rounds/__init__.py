"""Refinement rounds: Gaussians are compared with the input views and corrected."""

from ghgs_lit.method.rounds.coarse import Coarse, CoarseDepths, coarse_of, coarse_sizes
from ghgs_lit.method.rounds.rounds import NoRounds, Rounds, RoundsOptions, State, prediction_of

__all__ = [
    "Coarse",
    "CoarseDepths",
    "NoRounds",
    "Rounds",
    "RoundsOptions",
    "State",
    "coarse_of",
    "coarse_sizes",
    "prediction_of",
]
