"""The depth stage: depth z and a confidence for each pixel (paper, section 3.2)."""

from collections.abc import Iterable
from math import log
from typing import Literal

import torch
from jaxtyping import Bool, Float
from pydantic import Field, model_validator
from torch import Tensor, nn

from ghgs_lit.config.options import Options
from ghgs_lit.geometry.masks import BOUNDS_CHANNELS, relative_bounds
from ghgs_lit.geometry.projection import at_least_float32
from ghgs_lit.method.heads.dense import Part, decode
from ghgs_lit.method.heads.dpt import DPTHead
from ghgs_lit.method.heads.guide import PHOTO_CHANNELS, photo_guide
from ghgs_lit.method.plan import Plan
from ghgs_lit.ops.activation import bounded_sigmoid, confidence_of
from ghgs_lit.ops.photo_consistency import photo_consistency
from ghgs_lit.types import Batch, DepthBounds, DepthMaps, Tokens


def _bounded_inverse(fraction: Tensor, near: Tensor, far: Tensor) -> Tensor:
    """Interpolate linearly in ``1 / z``: equal steps of the fraction are equal steps in another image."""
    return near * far / (far * (1 - fraction) + near * fraction)


def _linear(fraction: Tensor, near: Tensor, far: Tensor) -> Tensor:
    return near + (far - near) * fraction


#: Functions from a fraction between near (0) and far (1) to depth.
BOUNDED = {"bounded_inverse": _bounded_inverse, "linear": _linear}


def bounded_depth(
    raw: Float[Tensor, "*n"], near: Float[Tensor, "*n"], far: Float[Tensor, "*n"], parameterization: str
) -> Float[Tensor, "*n"]:
    """Convert raw values of a head to depths z between bounds, in metres.

    Args:
        raw: outputs of a head; 0 is halfway in the given parameterization.
        near: in metres.
        far: in metres.
        parameterization: one of :data:`BOUNDED`.
    """
    return BOUNDED[parameterization](bounded_sigmoid(raw), near, far)


def inverse_linear(x: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """``1 / (x + 1e-8)`` as in the authors' release: of either sign and unbounded.

    Infinite at -1e-8, with a gradient of 0: the argument is replaced there, too, or the gradient would
    be 0 times infinity.
    """
    shifted = x + 1e-8
    is_pole = shifted == 0
    return torch.where(is_pole, torch.inf, 1 / torch.where(is_pole, 1.0, shifted))


class DepthHeadOptions(Options):
    """Depth head: tokens to a depth and a confidence for each pixel."""

    group = "depth_head"
    rectified_skip: bool = True
    """Residual units add the rectified input, as published weights expect; in training, units can die."""
    guide: bool = False
    """Add images, masks and bounds at full resolution to the input of the dense head (paper: false)."""
    consistency_depths: int = Field(0, ge=0, le=4096)
    """Number of depths between near and far whose photo-consistency is added to the guide (paper: 0)."""
    parameterization: Literal["bounded_inverse", "linear", "inverse_linear"] = "bounded_inverse"
    """bounded_inverse, linear: linear in 1 / z or in z between near and far of each pixel;
    inverse_linear: without bounds, for the authors' weights only."""
    start: float = Field(0.5, gt=0, lt=1)
    """Initial depth, as a fraction between near (0) and far (1)."""

    @model_validator(mode="after")
    def _check(self) -> "DepthHeadOptions":
        expected = "0, or a positive number where there are a guide and bounds"
        self.require(
            self.consistency_depths == 0 or (self.guide and self.is_bounded), "consistency_depths", expected
        )
        return self

    @property
    def is_bounded(self) -> bool:
        """Whether depths lie between bounds."""
        return self.parameterization in BOUNDED

    def build(self, dim_latent: int) -> "DepthHead":
        """Build the stage for tokens of width ``dim_latent``."""
        return DepthHead(self, dim_latent)


class DepthHead(nn.Module):
    """Dense head that predicts depth and confidence of each pixel from four layers of tokens."""

    def __init__(self, options: DepthHeadOptions, dim_latent: int):
        super().__init__()
        self.options = options
        self.start = log(options.start / (1 - options.start))
        seen = options.guide * (PHOTO_CHANNELS + options.is_bounded * BOUNDS_CHANNELS)
        self.dpt = DPTHead(dim_latent, 2, options.rectified_skip, seen + options.consistency_depths)
        if self.is_bounded:
            last = self.dpt.scratch.output_conv2[-1]
            nn.init.zeros_(last.weight)
            nn.init.zeros_(last.bias)

    @property
    def is_bounded(self) -> bool:
        """Whether depths lie between bounds, which :meth:`forward` then requires."""
        return self.options.is_bounded

    def forward(self, tokens: Tokens, batch: Batch, bounds: DepthBounds | None, plan: Plan) -> DepthMaps:
        """Predict depths in metres, and confidences of 1 or more as in published heads.

        Depths are valid at pixels of the subject if they are finite.

        Args:
            tokens: tokens of the encoder.
            batch: images, masks and cameras are read.
            bounds: in metres; None if :attr:`is_bounded` is False.
            plan: only its ``depth_windows`` are decoded; other depths are meaningless.
        """
        guide = None
        if self.dpt.guide is not None:
            maps = [] if bounds is None else [relative_bounds(bounds, batch.masks)]
            if self.options.consistency_depths:
                maps.append(photo_consistency(batch, bounds, self.options.consistency_depths))
            guide = photo_guide(batch, *maps)
        windows = plan.depth_windows
        p = plan.patch_size
        wanted = None if windows is None else plan.shown.repeat_interleave(p, -2).repeat_interleave(p, -1)
        value, confidence = _paste(decode(self.dpt, tokens, guide, windows, plan.together), batch, wanted)
        if self.is_bounded:
            depth = bounded_depth(value + self.start, bounds.near, bounds.far, self.options.parameterization)
        else:
            depth = inverse_linear(value)
        return finite_maps(depth, batch, confidence_of(confidence), bounds)


def finite_maps(depth: Tensor, batch: Batch, confidence: Tensor, bounds: DepthBounds | None) -> DepthMaps:
    """Build depth maps; depths that are not finite become 1 m and invalid.

    Args:
        depth: [B, V, H, W] in metres.
        batch: its masks define the valid pixels.
        confidence: [B, V, H, W].
        bounds: bounds of the depths, or None.
    """
    finite = depth.isfinite()
    return DepthMaps(torch.where(finite, depth, 1.0), batch.masks & finite, confidence, bounds)


def _paste(
    parts: Iterable[Part], batch: Batch, wanted: Bool[Tensor, "B V H W"] | None
) -> Float[Tensor, "o B V H W"]:
    """Paste decoded windows into maps of whole images, float32 or wider; 0 outside ``wanted``.

    Images share windows, so values elsewhere in a window depend on other subjects of the batch."""
    whole = None
    for part in parts:
        if whole is None:
            whole = part.maps.new_zeros(part.maps.shape[1], *batch.masks.shape)
        rows, columns = part.window.slices
        whole.flatten(1, 2)[:, part.images, rows, columns] = part.maps.transpose(0, 1)
    whole = at_least_float32(whole)
    return whole if wanted is None else torch.where(wanted, whole, 0)
