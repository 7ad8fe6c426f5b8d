"""Attention over given neighbours for CPUs: nothing is computed for other tokens."""

from ghgs_lit.recalibration.cpu.attention import attend, cosines, is_supported

__all__ = ["attend", "cosines", "is_supported"]
