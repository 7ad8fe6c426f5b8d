"""Predictions as files for other programs: one table of formats, one function that writes all."""

from ghgs_lit.prediction.export.prediction import (
    FORMATS,
    REPORT,
    output_files,
    output_options,
    require_free,
    write_prediction,
)
from ghgs_lit.prediction.export.subject import OutputOptions

__all__ = [
    "FORMATS",
    "REPORT",
    "OutputOptions",
    "output_files",
    "output_options",
    "require_free",
    "write_prediction",
]
