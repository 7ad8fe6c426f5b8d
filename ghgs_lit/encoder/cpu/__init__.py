"""Attention for CPUs with AVX2 or AVX-512: one pass, without a matrix of all scores in memory."""

from ghgs_lit.encoder.cpu.attention import attend, is_supported

__all__ = ["attend", "is_supported"]
