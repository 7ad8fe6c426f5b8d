"""Gaussian splatting: ``render`` and ``Renderer``; the definition of the image stands in ``settings``."""

from ghgs_lit.rendering.api import Renderer, render, resolve
from ghgs_lit.rendering.culling import Culled, cull
from ghgs_lit.rendering.gsplat_backend import BackendUnavailable
from ghgs_lit.rendering.settings import RasterSettings

__all__ = ["BackendUnavailable", "Culled", "RasterSettings", "Renderer", "cull", "render", "resolve"]
