"""The depth stage: one z-depth and one confidence for each pixel (paper, section 3.2)."""

from collections.abc import Mapping
from math import log

import torch
from jaxtyping import Float
from torch import Tensor, nn

from ghgs_lit.bounds.visual_hull import Interval, SubjectBounds
from ghgs_lit.errors import choice, require
from ghgs_lit.geometry.photo_consistency import photo_consistency
from ghgs_lit.geometry.projection import at_least_float32
from ghgs_lit.geometry.relative_depth import INTERVAL_CHANNELS, relative_interval
from ghgs_lit.heads.activations import CONFIDENCES
from ghgs_lit.heads.dense import decode_views, proportioned_dpt
from ghgs_lit.heads.guide import PHOTO_CHANNELS, photo_guide
from ghgs_lit.types import Batch, DepthMaps, Tokens


def _bounded_inverse(share: Tensor, near: Tensor, far: Tensor) -> Tensor:
    """Linear in ``1 / z``: equal steps are of equal size on the image of another view."""
    return near * far / (far * (1 - share) + near * share)


def _log(share: Tensor, near: Tensor, far: Tensor) -> Tensor:
    return near * torch.exp(share * torch.log(far / near))


def _linear(share: Tensor, near: Tensor, far: Tensor) -> Tensor:
    return near + (far - near) * share


#: From a share in [0, 1] of the way to a depth: 0 is ``near``, 1 is ``far``.
BOUNDED = {"bounded_inverse": _bounded_inverse, "log": _log, "linear": _linear}


def inverse_linear(x: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """``1 / (x + 1e-8)`` as in the authors' release: of either sign and without bound."""
    return 1 / (x + 1e-8)


class DepthHead(nn.Module):
    """Depth from the four layers of tokens by a dense head.

    Args:
        dim_latent: width of the tokens (from the encoder).
        dpt: options of the dense head; widths that are not given follow the encoder's.
        parameterization: ``bounded_inverse``, ``log`` or ``linear`` between the near and far of each pixel;
            ``inverse_linear`` for the authors' checkpoints only.
        bounds: where near and far come from: ``box`` or ``hull``; ``none`` with ``inverse_linear``.
        search: options of :class:`SubjectBounds`.
        start: share of the way from near to far at which training starts.
        guide: let the dense head see photographs, masks and the intervals of depth at full resolution.
        agreement: at so many depths of each interval the guide also tells how well the photographs agree
            (:func:`photo_consistency`); 0: none.
        views: ``all``, or ``subject``: views whose mask is empty are not decoded (their depths mean nothing).
    """

    def __init__(
        self,
        dim_latent: int,
        dpt: Mapping | None = None,
        parameterization: str = "bounded_inverse",
        bounds: str = "box",
        search: Mapping | None = None,
        start: float = 0.5,
        views: str = "all",
        guide: bool = False,
        agreement: int = 0,
    ):
        super().__init__()
        choice("depth_head.parameterization", parameterization, (*BOUNDED, "inverse_linear"))
        choice("depth_head.bounds", bounds, ("box", "hull", "none"))
        require(
            (bounds == "none") == (parameterization == "inverse_linear"),
            "depth_head.bounds",
            "none with inverse_linear, box or hull with all others",
            f"{bounds} with {parameterization}",
        )
        choice("depth_head.views", views, ("all", "subject"))
        require(0 < start < 1, "depth_head.start", "a share between 0 and 1", start)
        self.parameterization, self.start = parameterization, log(start / (1 - start))
        self.views = views
        self.bounds = None if bounds == "none" else SubjectBounds(kind=bounds, **(search or {}))
        bounded = guide and bounds != "none"
        require(
            agreement == 0 or (agreement > 0 and bounded),
            "depth_head.agreement",
            "0, or a positive number where there are a guide and bounds",
            agreement,
        )
        self.agreement = agreement
        channels = guide * PHOTO_CHANNELS + bounded * INTERVAL_CHANNELS + agreement
        self.dpt = proportioned_dpt(dim_latent, 2, guide_channels=channels, **(dpt or {}))
        if self.bounds is not None:
            last = self.dpt.scratch.output_conv2[-1]
            nn.init.zeros_(last.weight)
            nn.init.zeros_(last.bias)

    def interval(self, batch: Batch) -> Interval | None:
        """Near and far of each pixel, [B, V, H, W] in metres; ``None`` where depths are not bounded."""
        return None if self.bounds is None else self.bounds(batch.masks, batch.cameras)

    def forward(self, tokens: Tokens, batch: Batch, interval: Interval | None) -> DepthMaps:
        """Depths within ``interval`` of all pixels; those of the subject are valid.

        What is not finite becomes 1 m, invalid.
        """
        wanted = batch.masks.flatten(2).any(-1) | (self.views == "all")
        guide = None
        if self.dpt.guide is not None:
            maps = [] if interval is None else [relative_interval(interval, batch.masks)]
            if self.agreement:
                maps.append(photo_consistency(batch, interval, self.agreement))
            guide = photo_guide(batch, *maps)
        raw = at_least_float32(decode_views(self.dpt, tokens, guide, wanted))
        value, confidence = (raw[:, i].unflatten(0, batch.masks.shape[:2]) for i in range(2))
        near, far = interval or (None, None)
        if interval is None:
            depth = inverse_linear(value)
        else:
            depth = BOUNDED[self.parameterization]((value + self.start).sigmoid(), near, far)
        finite = depth.isfinite()
        return DepthMaps(
            depth=torch.where(finite, depth, 1.0),
            valid=batch.masks & finite,
            confidence=CONFIDENCES["expp1"](confidence),
            near=near,
            far=far,
        )
