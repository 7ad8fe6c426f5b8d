"""Metrics: pure functions, ``torchmetrics.Metric`` classes, and protocols that name what is reported."""

from importlib import import_module
from typing import TYPE_CHECKING

from ghgs_lit.metrics.flip import flip_map
from ghgs_lit.metrics.functional import PSNR_CAP, depth_error_mm, psnr, ssim

if TYPE_CHECKING:
    from ghgs_lit.metrics.metric import FLIP, LPIPS, PSNR, SSIM
    from ghgs_lit.metrics.protocol import ImageMetrics

__all__ = [
    "FLIP",
    "LPIPS",
    "PSNR",
    "PSNR_CAP",
    "SSIM",
    "ImageMetrics",
    "depth_error_mm",
    "flip_map",
    "psnr",
    "ssim",
]


def __getattr__(name: str):
    """Import the classes on first use: ``ghgs predict`` must not wait for torchmetrics."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module = "protocol" if name == "ImageMetrics" else "metric"
    return getattr(import_module(f"{__name__}.{module}"), name)
