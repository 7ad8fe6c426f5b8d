"""A measuring protocol: which metrics are computed, how, and under which names."""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ghgs_lit.errors import InputError, choice, require
from ghgs_lit.metrics.flip import PIXELS_PER_DEGREE
from ghgs_lit.metrics.functional import PSNR_CAP, REGIONS
from ghgs_lit.metrics.metric import FLIP, LPIPS, PSNR, SSIM, PerImageMetric

LPIPS_POLICIES = ("auto", "require", "off")


class ImageMetrics:
    """All metrics of a protocol: ``metrics(image, target, mask)`` gives one value per image by name.

    The names are ``psnr``, ``ssim``, ``flip`` and ``lpips`` for the whole image, with ``_box`` and
    ``_subject`` added for the other ``regions`` (no FLIP for the subject's pixels alone, since it blurs).

    Args:
        protocol: the name that is reported with every number.
        regions: where PSNR and SSIM are measured: ``image``, ``box``, ``subject``.
        ssim_padding: ``reflect`` (torchmetrics), ``valid`` (scikit-image) or ``zeros`` (the authors).
        clamp: clamp renders to [0, 1] first.
        lpips: ``auto`` leaves LPIPS out where it is not available (``left_out`` says why), ``require`` raises
            an error there, ``off`` never computes it.
        lpips_net: ``vgg``, ``alex`` or ``squeeze``.
        lpips_signed: feed LPIPS [-1, 1] (its calibration) instead of [0, 1].
        flip_pixels_per_degree: FLIP's viewing distance.
        box_margin: part of the box's height and width that is added to it on each side.
    """

    def __init__(
        self,
        protocol: str = "correct",
        regions: Sequence[str] = REGIONS,
        ssim_padding: str = "reflect",
        clamp: bool = True,
        lpips: str = "auto",
        lpips_net: str = "vgg",
        lpips_signed: bool = True,
        flip_pixels_per_degree: float = PIXELS_PER_DEGREE,
        box_margin: float = 0.0,
    ):
        choice("metrics.lpips", lpips, LPIPS_POLICIES)
        for region in regions:
            choice("metrics.regions", region, REGIONS)
        require(box_margin >= 0, "metrics.box_margin", "a share of at least 0", box_margin)
        self.protocol, self.clamp, self.box_margin = protocol, clamp, box_margin
        self.metrics: dict[str, PerImageMetric] = {}
        self.left_out: dict[str, str] = {}
        for region in regions:
            suffix = "" if region == "image" else f"_{region}"
            self.metrics[f"psnr{suffix}"] = PSNR(region, box_margin)
            self.metrics[f"ssim{suffix}"] = SSIM(ssim_padding, region, box_margin=box_margin)
            if region != "subject":
                self.metrics[f"flip{suffix}"] = FLIP(region, flip_pixels_per_degree, box_margin=box_margin)
        if lpips != "off":
            try:
                self.metrics["lpips"] = LPIPS(lpips_net, lpips_signed)
            except InputError as error:
                if lpips == "require":
                    raise
                self.left_out["lpips"] = str(error)

    def to(self, device: torch.device | str) -> "ImageMetrics":
        self.metrics = {name: metric.to(device) for name, metric in self.metrics.items()}
        return self

    @property
    def definitions(self) -> dict[str, str]:
        """How each metric and region is defined, to be stored beside the numbers."""
        said = {
            "image": f"renders {'clamped to [0, 1]' if self.clamp else 'as they are'}, RGB, data range 1",
            "psnr": f"-10 log10(MSE) of each image, at most {PSNR_CAP:g} dB (equal images)",
            "depth_error_mm": "mean |z - true z| over a subject's input pixels with predicted and true depth",
        }
        for metric in self.metrics.values():
            if isinstance(metric, SSIM):
                said["ssim"] = f"11x11 Gaussian window, sigma 1.5, padding {metric.padding}"
            elif isinstance(metric, FLIP):
                said["flip"] = f"FLIP at {metric.pixels_per_degree:.2f} pixels a degree"
            elif isinstance(metric, LPIPS):
                said["lpips"] = f"{metric.net} on {'[-1, 1]' if metric.signed else '[0, 1]'}, whole image"
            if metric.region == "box":
                margin = f", {self.box_margin:g} of its sides wider on each side" if self.box_margin else ""
                said["box"] = f"the smallest upright box of the subject's mask in the target{margin}"
            elif metric.region == "subject":
                said["subject"] = "the pixels of the subject's mask in the target"
        return said

    @torch.no_grad()
    def __call__(
        self,
        image: Float[Tensor, "n 3 h w"],
        target: Float[Tensor, "n 3 h w"],
        mask: Bool[Tensor, "n h w"],
    ) -> dict[str, Tensor]:
        """One value per image for each metric; nan where a region is empty."""
        image = image.clamp(0, 1) if self.clamp else image
        maps: dict[tuple, Tensor] = {}
        for metric in self.metrics.values():
            if metric.map_key not in maps:
                maps[metric.map_key] = metric.maps(image, target)
        return {name: metric.pool(maps[metric.map_key], mask) for name, metric in self.metrics.items()}
