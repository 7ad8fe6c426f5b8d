"""Rendering of Gaussians: ``render`` and ``Renderer``; ``settings`` defines the image."""

from ghgs_lit.rendering.api import Renderer, render
from ghgs_lit.rendering.gsplat_backend import BackendUnavailable
from ghgs_lit.rendering.settings import RasterSettings

__all__ = ["BackendUnavailable", "RasterSettings", "Renderer", "render"]
