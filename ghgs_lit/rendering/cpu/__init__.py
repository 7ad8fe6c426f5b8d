"""The project's own rasterizer for CPUs: kernels on explicit vectors; ``layout`` tells of their data."""

from ghgs_lit.rendering.cpu.backend import rasterize

__all__ = ["rasterize"]
