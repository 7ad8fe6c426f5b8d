"""Rounds for CPUs: all that is done with a few Gaussians, then with the next."""

from ghgs_lit.rounds.cpu.network import answered, compare, remembered

__all__ = ["answered", "compare", "remembered"]
