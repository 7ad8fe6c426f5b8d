"""Rounds of refinement: Gaussians are compared with the photographs and corrected."""

from ghgs_lit.rounds.rounds import Rounds, RoundsOptions, State, prediction_of, replaced

__all__ = ["Rounds", "RoundsOptions", "State", "prediction_of", "replaced"]
