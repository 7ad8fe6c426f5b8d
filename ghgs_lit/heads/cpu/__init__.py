"""The Gaussian head for CPUs: all that is done with a few Gaussians, then with the next."""

from ghgs_lit.heads.cpu.activation import activate, is_supported
from ghgs_lit.heads.cpu.networks import attributes

__all__ = ["activate", "attributes", "is_supported"]
