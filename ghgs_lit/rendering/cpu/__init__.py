"""A rasterizer for CPUs, in kernels with explicit vectors; ``layout`` describes their data."""

from ghgs_lit.rendering.cpu.backend import rasterize

__all__ = ["rasterize"]
