"""Raw attributes of Gaussians and their activations: in footprints of pixels,
or as in the authors' release."""

import dataclasses
from dataclasses import dataclass
from math import log

import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from pydantic import model_validator
from torch import Tensor

from ghgs_lit.config.options import Amount, Options, Positive, Share
from ghgs_lit.geometry.rotations import unit
from ghgs_lit.ops.activation import (
    Attributes,
    Constants,
)

#: Offset of a Gaussian from its pixel's point along each axis, in metres, for a raw value of 1
#: where there is no limit; and the default limit.
OFFSET_UNIT = 0.05
#: The largest scale in footprints: a splat as large as a limb would hide errors beneath it.
SCALE_CAP = 4.0
#: Opacity at the start of training: high, since transparent splats do not recover.
OPACITY_START = 0.8


def _logit(probability: float) -> float:
    return log(probability / (1 - probability))


#: Widths of the raw offset, scale, rotation, opacity and color, and their sum.
_WIDTHS = (3, 3, 4, 1, 3)
RAW_VALUES = sum(_WIDTHS)


@dataclass(frozen=True)
class RawGaussians:
    """Attributes before their activations, and the descriptors that they are computed from.

    Attributes:
        descriptors: of the Gaussians' pixels, from the dense head.
        offset: from the point of the pixel.
        scale: along three axes.
        rotation: a quaternion less the one without rotation, where attributes are in footprints.
        opacity: 0 is the start of training, where attributes are in footprints.
        color: change of the pixel's colour; None: none.
        image: numbers of the images (``b * V + v``) that the Gaussians belong to, ascending.
        pixel: row-major indices of their pixels.
        splits: number of rows of each element.
        real: which rows become Gaussians, others get opacity 0; None: all.
    """

    descriptors: Float[Tensor, "N c"]
    offset: Float[Tensor, "N 3"]
    scale: Float[Tensor, "N 3"]
    rotation: Float[Tensor, "N 4"]
    opacity: Float[Tensor, " N"]
    color: Float[Tensor, "N 3"] | None
    image: Int[Tensor, " N"]
    pixel: Int[Tensor, " N"]
    splits: tuple[int, ...]
    real: Bool[Tensor, " N"] | None = None

    def changed(self, change: Float[Tensor, "N c"]) -> "RawGaussians":
        """The raw attributes plus a change, without a change of descriptors.

        Args:
            change: values of offset, scale, rotation, opacity and color,
                :data:`RAW_VALUES` together.
        """
        offset, scale, rotation, opacity, color = change.split(_WIDTHS, -1)
        return dataclasses.replace(
            self,
            offset=self.offset + offset,
            scale=self.scale + scale,
            rotation=self.rotation + rotation,
            opacity=self.opacity + opacity[:, 0],
            color=None if self.color is None else self.color + color,
        )


class FootprintAttributes(Options):
    """Raw values to attributes in units of a pixel's footprint, ``z / f`` metres; zeros give a
    splat on the surface. The paper gives no values."""

    scale_floor: Positive = 0.15
    """Least scale in footprints; it leaves no holes when splats are rendered at a higher
    resolution."""
    scale_start: Positive = 0.25
    """Scale at which training starts, in footprints."""
    thickness_start: Positive | None = None
    """Scale of the third axis at which training starts, in footprints; null: as the others."""
    inward: Amount = 0.0
    """Distance along the third axis to which training starts moving the splats, in footprints: with
    axes of the surface, away from the camera. The part of a splat outside its pixel then ends at the
    silhouette."""
    opacity_floor: Share = 0.1
    """Least opacity: below 1/255 a splat has no gradient left."""

    @model_validator(mode="after")
    def _check(self) -> "FootprintAttributes":
        for name in ("scale_start", "thickness_start"):
            start = getattr(self, name)
            limits = f"between scale_floor={self.scale_floor:g} and {SCALE_CAP:g}"
            fits = start is None or self.scale_floor < start < SCALE_CAP
            self.require(fits, name, f"a number {limits}")
        self.require(self.opacity_floor < OPACITY_START, "opacity_floor", f"a number below {OPACITY_START:g}")
        return self

    @property
    def scale_range(self) -> float:
        """Logarithm of the ratio of the largest to the smallest scale."""
        return log(SCALE_CAP / self.scale_floor)

    @property
    def scale_biases(self) -> tuple[float, float]:
        """Biases of raw scales of the first two axes and of the third,
        so that 0 gives the start."""
        thickness = self.scale_start if self.thickness_start is None else self.thickness_start
        starts = (self.scale_start, thickness)
        return tuple(_logit(log(start / self.scale_floor) / self.scale_range) for start in starts)

    @property
    def opacity_bias(self) -> float:
        """Bias of raw opacities, so that 0 gives the start."""
        return _logit((OPACITY_START - self.opacity_floor) / (1 - self.opacity_floor))

    def constants(self, offset_limit: float | None, color_limit: float) -> Constants:
        """Numbers of :func:`ghgs_lit.ops.activation.footprint_attributes`.

        Args:
            offset_limit: of ``gaussian_head``, in metres; None: none.
            color_limit: of ``gaussian_head``.
        """
        offsets = (offset_limit or 0.0, OFFSET_UNIT, self.inward)
        size = (self.scale_floor, self.scale_range, *self.scale_biases)
        return Constants(*offsets, *size, self.opacity_floor, self.opacity_bias, color_limit)


def release_attributes(
    offset: Float[Tensor, "N 3"],
    scale: Float[Tensor, "N 3"],
    rotation: Float[Tensor, "N 4"],
    opacity: Float[Tensor, " N"],
    footprint: Float[Tensor, " N"],
) -> Attributes:
    """Attributes as in the authors' release: offsets and scales in metres, without bound.

    Args:
        offset: raw, as are the next three.
        scale: raw.
        rotation: raw.
        opacity: raw.
        footprint: not read.
    """
    return offset, F.softplus(scale, beta=100), unit(rotation), opacity.sigmoid()
