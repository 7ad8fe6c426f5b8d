"""Rendering of Gaussians: ``render`` and ``Renderer``; ``RasterSettings`` defines the image."""

from ghgs_lit.ops.rasterization.settings import RasterSettings
from ghgs_lit.rendering.api import Renderer, render
from ghgs_lit.rendering.gsplat_backend import BackendUnavailable

__all__ = ["BackendUnavailable", "RasterSettings", "Renderer", "render"]
