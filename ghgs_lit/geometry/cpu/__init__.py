"""Photo-consistency for CPUs: all depths of a pixel at once."""

from ghgs_lit.geometry.cpu.sweep import padded, sweep
from ghgs_lit.kernels.pool import is_supported

__all__ = ["is_supported", "padded", "sweep"]
