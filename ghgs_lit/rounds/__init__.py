"""Rounds that look again: Gaussians are compared with the photographs and corrected."""

from ghgs_lit.rounds.rounds import Rounds, State

__all__ = ["Rounds", "State"]
