"""Export predictions to files for other programs, in the formats of ``FORMATS``."""

from ghgs_capture.export.instants import Instants
from ghgs_capture.export.prediction import SHEET, output_files, output_options, write_prediction
from ghgs_capture.export.reports import require_free
from ghgs_capture.export.subject import OutputOptions

__all__ = [
    "SHEET",
    "Instants",
    "OutputOptions",
    "output_files",
    "output_options",
    "require_free",
    "write_prediction",
]
