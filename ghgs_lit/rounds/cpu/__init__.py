"""The network of the rounds for CPUs: all its layers for a few Gaussians, then for the next."""

from ghgs_lit.rounds.cpu.network import is_supported, remembered

__all__ = ["is_supported", "remembered"]
