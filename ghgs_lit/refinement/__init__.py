"""Refinement of a prediction, or of cameras, by a few seconds of optimisation through the rasterizer."""

from ghgs_lit.refinement.cameras import CameraRefinement, pixels_moved
from ghgs_lit.refinement.refinement import Change, Descent, Refinement

__all__ = ["CameraRefinement", "Change", "Descent", "Refinement", "pixels_moved"]
