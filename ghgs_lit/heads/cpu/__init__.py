"""The Gaussian head's activations for CPUs: all attributes of a few Gaussians, then of the next."""

from ghgs_lit.heads.cpu.activation import activate, is_supported

__all__ = ["activate", "is_supported"]
