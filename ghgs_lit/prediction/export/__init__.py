"""Predictions as files for other programs: one module for each format, one function that writes all."""

from ghgs_lit.prediction.export.prediction import WRITERS, output_options, write_prediction
from ghgs_lit.prediction.export.scene import OutputOptions

__all__ = ["WRITERS", "OutputOptions", "output_options", "write_prediction"]
