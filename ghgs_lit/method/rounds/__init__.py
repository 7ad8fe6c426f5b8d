"""Rounds of refinement: Gaussians are compared with the photographs and corrected."""

from ghgs_lit.method.rounds.coarse import Coarse, CoarseDepths, coarse_of, coarse_sizes, with_known_height
from ghgs_lit.method.rounds.rounds import Rounds, RoundsOptions, State, prediction_of, replaced

__all__ = [
    "Coarse",
    "CoarseDepths",
    "Rounds",
    "RoundsOptions",
    "State",
    "coarse_of",
    "coarse_sizes",
    "prediction_of",
    "replaced",
    "with_known_height",
]
