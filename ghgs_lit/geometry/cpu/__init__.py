"""Photo-consistency for CPUs: a depth that cannot win is left after one channel."""

from ghgs_lit.geometry.cpu.sweep import sweep
from ghgs_lit.kernels.pool import is_supported

__all__ = ["is_supported", "sweep"]
