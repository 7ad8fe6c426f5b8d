"""Raw attributes of Gaussians and their activations: in footprints of pixels, or as in the authors'
release."""

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

#: Offset in metres of a Gaussian from its pixel's point along each axis for a raw value of 1, if there
#: is no limit; also the default limit.
OFFSET_UNIT = 0.05
#: Largest scale in footprints: a splat as large as a limb would hide errors beneath it.
SCALE_CAP = 4.0
#: Initial opacity: high, since transparent splats do not recover in training.
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
        descriptors: features of the Gaussians' pixels, from the dense head.
        offset: offset from the point of the pixel.
        scale: scales along three axes.
        rotation: quaternion; with attributes in footprints, minus the identity.
        opacity: with attributes in footprints, 0 is the initial value.
        color: change of the pixel's colour; None: no change.
        image: index ``b * V + v`` of the image that each Gaussian belongs to, ascending.
        pixel: row-major index of its pixel in the image.
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

    def add_change(self, change: Float[Tensor, "N c"]) -> "RawGaussians":
        """Add a change of offset, scale, rotation, opacity and color (:data:`RAW_VALUES` channels)."""
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
    """Attributes in units of a pixel's footprint, ``z / f`` metres; raw values of 0 give a splat on the
    surface. The paper gives no values."""

    scale_floor: Positive = 0.15
    """Least scale in footprints; it prevents holes when splats are rendered at a higher resolution."""
    scale_start: Positive = 0.25
    """Initial scale in footprints."""
    thickness_start: Positive | None = None
    """Initial scale of the third axis in footprints; null: as the others."""
    inward: Amount = 0.0
    """Initial distance of splats along the third axis, in footprints: with surface axes, away from the
    camera. The part of a splat outside its pixel then ends at the silhouette."""
    opacity_floor: Share = 0.1
    """Least opacity: below 1/255 a splat gets no gradient."""

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
        """Biases of the raw scales of the first two axes and of the third; raw values of 0 then give the
        initial scales."""
        thickness = self.scale_start if self.thickness_start is None else self.thickness_start
        starts = (self.scale_start, thickness)
        return tuple(_logit(log(start / self.scale_floor) / self.scale_range) for start in starts)

    @property
    def opacity_bias(self) -> float:
        """Bias of raw opacities; a raw value of 0 then gives the initial opacity."""
        return _logit((OPACITY_START - self.opacity_floor) / (1 - self.opacity_floor))

    def constants(self, offset_limit: float | None, color_limit: float) -> Constants:
        """Constants of :func:`ghgs_lit.ops.activation.footprint_attributes`.

        Args:
            offset_limit: ``gaussian_head.offset_limit`` in metres; None: no limit.
            color_limit: ``gaussian_head.color_limit``.
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
    """Activate raw attributes as in the authors' release: offsets and scales in metres, unbounded;
    ``footprint`` is not used."""
    return offset, F.softplus(scale, beta=100), unit(rotation), opacity.sigmoid()
