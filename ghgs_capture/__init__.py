"""Turn a user's photographs and calibration into splat files, web pages and weights for their rig.

A plug-in of :mod:`ghgs_lit`, loaded through the same entry point as a user's: it registers the verbs for
photographs, and the data set ``instants`` for the instants of a sequence.
"""

from importlib import import_module
from typing import TYPE_CHECKING

from ghgs_lit.config.registry import offer

if TYPE_CHECKING:
    from ghgs_capture.capture import Capture
    from ghgs_capture.prediction import predict

offer("data", instants="ghgs_capture.learning.Instants")
offer(
    "verb",
    predict="ghgs_capture.verbs.Predict",
    view="ghgs_capture.verbs.View",
    adapt="ghgs_capture.verbs.Adapt",
    doctor="ghgs_capture.verbs.Doctor",
)

_MODULES = {"Capture": "ghgs_capture.capture", "predict": "ghgs_capture.prediction"}
__all__ = ["Capture", "predict"]


def __getattr__(name: str):
    """Import public names on first use, so that ``ghgs --help`` does not import PyTorch."""
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_MODULES[name]), name)
