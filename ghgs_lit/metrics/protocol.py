"""Measuring protocols: which metrics are computed, how, and under which names."""

import warnings
from collections.abc import Iterable
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ghgs_lit.config.options import Options
from ghgs_lit.errors import InputError, import_optional
from ghgs_lit.metrics.functional import (
    decibels,
    flip_map,
    psnr_box_40,
    sharpness,
    spill,
    squared_error,
    ssim_map,
)
from ghgs_lit.metrics.regions import mean_over, region_of

#: Metrics that do not average a map over a region.
FURTHER = {"psnr_box_40": psnr_box_40, "spill": spill, "sharpness": sharpness}
#: Metrics of each protocol; SSIM and FLIP use windows, which thin regions do not fill.
MEASURED = {
    "release": ("psnr", "ssim", "flip"),
    "correct": (
        "psnr", "ssim", "flip", "psnr_box", "ssim_box", "flip_box", "psnr_subject", "ssim_subject",
        "psnr_edge", *FURTHER,
    ),
}  # fmt: skip


class LPIPS:
    """LPIPS of whole images, with torchmetrics' network.

    Args:
        signed: map [0, 1] to [-1, 1], for which the network was calibrated; the authors' evaluation
            does not.
        key: prefix of error messages.

    Raises:
        InputError: torchvision or the weights are not available."""

    def __init__(self, signed: bool = True, key: str = "LPIPS"):
        import_optional("torchvision", "lpips", key)
        from torchmetrics.image.lpip import LearnedPerceptualImagePatchSimilarity

        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                self.network = LearnedPerceptualImagePatchSimilarity(net_type="vgg").net
        except Exception as error:  # a download can fail in many ways
            reason = " ".join(str(error).split())
            raise InputError(f"{key}: the weights of 'vgg' could not be loaded: {reason}") from error
        self.signed = signed

    def __call__(
        self, image: Float[Tensor, "n 3 h w"], target: Float[Tensor, "n 3 h w"]
    ) -> Float[Tensor, " n"]:
        """LPIPS distance of each image, on the network's device.

        Args:
            image: renders; values outside the network's range are clamped.
            target: images in [0, 1]."""
        # With ``signed`` the network rejects values outside [0, 1], which renders can have.
        low, high = (0, 1) if self.signed else (-1, None)
        images = image.float().clamp(low, high).split(1)
        targets = target.float().clamp(low, high).split(1)
        pairs = zip(images, targets, strict=True)
        # The network alone: torchmetrics' Metric would store the values of all calls.
        return torch.cat([self.network(*pair, normalize=self.signed) for pair in pairs]).flatten()


class MetricsOptions(Options):
    """Options of image metrics."""

    group = "metrics"
    protocol: Literal["correct", "release"] = "correct"
    """correct: renders clamped to [0, 1], SSIM as in torchmetrics, LPIPS on [-1, 1], for which it
    was calibrated; whole images, the mask's bounding box, its pixels and its edges. release: as the
    authors' code: no clamp, SSIM padded with zeros, LPIPS on [0, 1]; whole images. Reported with every
    number."""
    lpips: Literal["auto", "require", "off"] = "auto"
    """auto: skipped with a message if torchvision or its weights are missing; require: an error if they
    are; off: never computed."""

    beside: Literal["correct", "release"] | None = None
    """A second protocol to measure as well; its name is appended to its metrics (psnr_correct)."""

    @property
    def is_release(self) -> bool:
        """Whether metrics are computed as in the authors' code."""
        return self.protocol == "release"

    def build(self) -> "ImageMetrics":
        """Build the metrics; raises InputError as :class:`ImageMetrics` does."""
        return ImageMetrics(self)


class ImageMetrics:
    """All metrics of a protocol.

    Names are those in :data:`MEASURED`, with the suffix ``_box``, ``_subject`` or ``_edge`` for other regions
    than the whole image, and ``lpips``.

    Attributes:
        protocol: name of the protocol, reported with every number.
        left_out: reason for each missing metric, by name.
        beside: metrics of the second protocol, or None.

    Raises:
        InputError: LPIPS is required but not available."""

    def __init__(self, options: MetricsOptions):
        self.options = options
        self.protocol = options.protocol
        self.lpips: LPIPS | None = None
        self.left_out: dict[str, str] = {}
        if options.lpips != "off":
            try:
                self.lpips = LPIPS(signed=not options.is_release)
            except InputError as error:
                if options.lpips == "require":
                    raise
                self.left_out["lpips"] = str(error)
        self.beside: ImageMetrics | None = None
        if options.beside not in (None, options.protocol):
            self.beside = MetricsOptions(protocol=options.beside, lpips=options.lpips).build()

    def to(self, device: torch.device | str) -> "ImageMetrics":
        """Move the network of LPIPS to a device; returns ``self``."""
        if self.lpips is not None:
            self.lpips.network = self.lpips.network.to(device)
        if self.beside is not None:
            self.beside.to(device)
        return self

    @property
    def names(self) -> list[str]:
        """Names of the values returned by a call, in order."""
        beside = self.beside.names if self.beside else []
        return [*self._of_protocol, *(f"{name}_{self.options.beside}" for name in beside)]

    @property
    def _of_protocol(self) -> list[str]:
        return [*MEASURED[self.protocol], *["lpips"] * (self.lpips is not None)]

    def __call__(
        self,
        image: Float[Tensor, "n 3 h w"],
        target: Float[Tensor, "n 3 h w"],
        mask: Bool[Tensor, "n h w"],
        depth: Float[Tensor, "n h w"] | None = None,
    ) -> dict[str, Tensor]:
        """Compute all metrics of the protocol.

        Args:
            image: renders, RGB in [0, 1] or slightly outside.
            target: ground truth images, RGB in [0, 1].
            mask: of the subject in the targets.
            depth: true z of the targets in metres, 0 where unknown; None: unknown.

        Returns:
            One value per image for each of :attr:`names`; nan if a region is empty."""
        values = self.measure(image, target, mask, self._of_protocol, depth)
        if self.beside is not None:
            for name, value in self.beside(image, target, mask, depth).items():
                values[f"{name}_{self.options.beside}"] = value
        return values

    @torch.no_grad()
    def measure(
        self,
        image: Float[Tensor, "n 3 h w"],
        target: Float[Tensor, "n 3 h w"],
        mask: Bool[Tensor, "n h w"],
        names: Iterable[str],
        depth: Float[Tensor, "n h w"] | None = None,
    ) -> dict[str, Tensor]:
        """Compute only some metrics of the protocol.

        Args:
            image, target, mask, depth: as in a call.
            names: names of metrics (:data:`MEASURED` of any protocol, or ``lpips``).

        Returns:
            One value per image for each name."""
        if not self.options.is_release:
            image = image.clamp(0, 1)
        maps: dict[str, Tensor] = {}
        regions: dict[str, Tensor | None] = {}
        values = {}
        for name in names:
            if name == "lpips":
                values[name] = self.lpips(image, target)
                continue
            if name in FURTHER:
                values[name] = FURTHER[name](image, target, mask)
                continue
            metric, _, region = name.partition("_")
            if metric not in maps:
                maps[metric] = self._map(metric, image, target)
            if region not in regions:
                regions[region] = region_of(mask, region or "image", depth)
            mean = mean_over(maps[metric], regions[region])
            values[name] = decibels(mean) if metric == "psnr" else mean
        return values

    def _map(self, metric: str, image: Tensor, target: Tensor) -> Tensor:
        """Per-pixel map of a metric, to be averaged over a region."""
        if metric == "psnr":
            return squared_error(image, target)
        if metric == "ssim":
            return ssim_map(image, target, "zeros" if self.options.is_release else "reflect").mean(1)
        return flip_map(image, target)
