"""Training losses."""

from ghgs_lit.losses.losses import Losses
from ghgs_lit.losses.terms import chamfer, depth, render_l1, render_ssim

__all__ = ["Losses", "chamfer", "depth", "render_l1", "render_ssim"]
