"""Human Gaussian splatting from a few calibrated photographs: training, ablations, sweeps, tables."""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ghgs_lit.execution import Predictor
    from ghgs_lit.method.model import GHGS
    from ghgs_lit.rendering import render
    from ghgs_lit.types import Batch, Cameras, Gaussians

_MODULES = {
    "GHGS": "ghgs_lit.method.model",
    "Batch": "ghgs_lit.types",
    "Cameras": "ghgs_lit.types",
    "Gaussians": "ghgs_lit.types",
    "Predictor": "ghgs_lit.execution",
    "render": "ghgs_lit.rendering",
}
__all__ = ["GHGS", "Batch", "Cameras", "Gaussians", "Predictor", "render"]


def __getattr__(name: str):
    """Import public names on first use, so that ``ghgs --help`` does not load PyTorch."""
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_MODULES[name]), name)


def __dir__() -> list[str]:
    return [*globals(), *__all__]
