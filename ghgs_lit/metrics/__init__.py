"""Metrics: pure functions, ``torchmetrics.Metric`` classes, and protocols that name what is reported."""

from ghgs_lit.metrics.flip import flip_map
from ghgs_lit.metrics.functional import PSNR_CAP, depth_error_mm, psnr, ssim
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
