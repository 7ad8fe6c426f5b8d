"""Seconds of optimisation through the rasterizer, from a prediction."""

from ghgs_lit.refinement.refinement import Refinement, Report

__all__ = ["Refinement", "Report"]
