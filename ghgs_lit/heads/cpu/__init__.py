"""The Gaussian head for CPUs: all that is done with a few Gaussians, then with the next."""

from ghgs_lit.heads.cpu.activation import activate, attributes, is_supported

__all__ = ["activate", "attributes", "is_supported"]
