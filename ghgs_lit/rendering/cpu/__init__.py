"""The project's own rasterizer for CPUs: Numba kernels on explicit vectors; see ``layout`` and ``raster``."""

from ghgs_lit.rendering.cpu.backend import rasterize

__all__ = ["rasterize"]
