"""A measuring protocol: which metrics, how each is computed, under which names."""

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
    """All metrics of a protocol at once: ``metrics(image, target, mask)`` gives a value an image by name.

    Names are ``psnr``, ``ssim``, ``flip`` and ``lpips`` for the whole image, with ``_box`` and
    ``_subject`` for the other ``regions`` (FLIP: not the subject's pixels alone, since it is a blur).

    Args:
        protocol: the name that every reported figure carries.
        regions: where PSNR and SSIM are taken: ``image``, ``box``, ``subject``.
        box_margin: share of the box's height and width that is added to it on each side.
        ssim_padding: ``reflect`` (torchmetrics), ``valid`` (scikit-image) or ``zeros`` (the authors).
        clamp: whether renders are clamped to [0, 1] first.
        lpips: ``auto`` leaves LPIPS out where it cannot be had (``left_out`` says why); ``require`` fails;
            ``off``.
        lpips_net: ``vgg``, ``alex`` or ``squeeze``.
        lpips_signed: whether LPIPS sees [-1, 1] (as it was calibrated) or [0, 1].
        flip_pixels_per_degree: FLIP's viewing distance.
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
        """What each name means, for whoever reads the numbers later."""
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
        """One value an image for each metric; nan where a region is empty."""
        image = image.clamp(0, 1) if self.clamp else image
        maps: dict[tuple, Tensor] = {}
        for metric in self.metrics.values():
            if metric.source not in maps:
                maps[metric.source] = metric.maps(image, target)
        return {name: metric.pool(maps[metric.source], mask) for name, metric in self.metrics.items()}
