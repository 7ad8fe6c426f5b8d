"""Image and geometry metrics: pure functions, and named protocols that compute them."""

from ghgs_lit.metrics.functional import PSNR_CAP, depth_error_mm, flip_map, psnr, ssim, surface_error_mm
from ghgs_lit.metrics.protocol import FURTHER, ImageMetrics, MetricsOptions

__all__ = [
    "FURTHER",
    "PSNR_CAP",
    "ImageMetrics",
    "MetricsOptions",
    "depth_error_mm",
    "flip_map",
    "psnr",
    "ssim",
    "surface_error_mm",
]
