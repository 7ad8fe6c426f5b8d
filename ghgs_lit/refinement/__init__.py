"""Seconds of optimisation through the rasterizer, from a prediction."""

from ghgs_lit.refinement.refinement import Change, Refinement, Report

__all__ = ["Change", "Refinement", "Report"]
