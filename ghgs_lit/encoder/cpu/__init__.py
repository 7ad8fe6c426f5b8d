"""The project's own attention for CPUs with 512-bit vectors: one pass, no matrix of scores in memory."""

from ghgs_lit.encoder.cpu.attention import attend, is_supported

__all__ = ["attend", "is_supported"]
