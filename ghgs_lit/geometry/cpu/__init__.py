"""Photo-consistency for CPUs: a depth that cannot win is left after one channel."""

from ghgs_lit.geometry.cpu.sweep import is_supported, sweep

__all__ = ["is_supported", "sweep"]
