"""The pure functions as ``torchmetrics.Metric``: means over all images."""

import warnings

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torchmetrics import Metric

from ghgs_lit.errors import InputError, choice, require
from ghgs_lit.metrics import functional
from ghgs_lit.metrics.flip import PIXELS_PER_DEGREE, flip_map

Images = Float[Tensor, "n 3 h w"]
Masks = Bool[Tensor, "n h w"]


class PerImageMetric(Metric):
    """Mean of one value per image; undefined values (nan) are left out; nan where all are undefined.

    Args:
        region: the pixels that count: ``image``, ``box`` or ``subject``.
        box_margin: part of the box's height and width that is added on each side.
        kwargs: of ``torchmetrics.Metric``.
    """

    full_state_update = False
    is_differentiable = False
    map_key: tuple = ()
    """Identifies the result of :meth:`maps`: metrics of equal key can share it."""

    def __init__(self, region: str = "image", box_margin: float = 0.0, **kwargs):
        super().__init__(**kwargs)
        choice("region", region, functional.REGIONS)
        require(box_margin >= 0, "box_margin", "a share of at least 0", box_margin)
        self.region, self.box_margin = region, box_margin
        self.add_state("total", torch.zeros((), dtype=torch.float64), dist_reduce_fx="sum")
        self.add_state("count", torch.zeros((), dtype=torch.long), dist_reduce_fx="sum")

    def maps(self, image: Images, target: Images) -> Tensor:
        """The part that does not depend on the region."""
        raise NotImplementedError

    def pool(self, maps: Tensor, mask: Masks) -> Float[Tensor, " n"]:
        """One value per image; ``mask`` is the subject's mask in the target."""
        raise NotImplementedError

    def region_of(self, mask: Masks) -> Masks | None:
        """The pixels that count; None for all pixels."""
        return functional.region_of(mask, self.region, self.box_margin)

    def per_image(self, image: Images, target: Images, mask: Masks) -> Float[Tensor, " n"]:
        """The value of each image."""
        return self.pool(self.maps(image, target), mask)

    def update(self, image: Images, target: Images, mask: Masks) -> None:
        values = self.per_image(image, target, mask)
        defined = ~values.isnan()
        self.total += values[defined].double().sum()
        self.count += defined.sum()

    def compute(self) -> Tensor:
        return self.total / self.count

    def set_dtype(self, dst_type):
        """Keep the dtype of the states: a mean over many images is accumulated in float64."""
        return self


class PSNR(PerImageMetric):
    """PSNR in dB over a region, at most ``functional.PSNR_CAP`` (equal images)."""

    higher_is_better = True
    map_key = ("squared_error",)

    def maps(self, image: Images, target: Images) -> Tensor:
        return functional.squared_error(image, target)

    def pool(self, maps: Tensor, mask: Masks) -> Float[Tensor, " n"]:
        return functional.decibels(functional.mean_over(maps, self.region_of(mask)))


class SSIM(PerImageMetric):
    """SSIM over a region; ``padding`` as in :func:`~ghgs_lit.metrics.functional.ssim_map`."""

    higher_is_better = True

    def __init__(self, padding: str = "reflect", region: str = "image", **kwargs):
        super().__init__(region, **kwargs)
        choice("ssim.padding", padding, functional.PADDINGS)
        self.padding, self.map_key = padding, ("ssim", padding)

    def maps(self, image: Images, target: Images) -> Tensor:
        return functional.ssim_map(image, target, self.padding).mean(1)

    def pool(self, maps: Tensor, mask: Masks) -> Float[Tensor, " n"]:
        return functional.mean_inside(maps, self.region_of(mask))


class FLIP(PerImageMetric):
    """Mean FLIP over a region, for a viewer who sees ``pixels_per_degree``."""

    higher_is_better = False

    def __init__(self, region: str = "image", pixels_per_degree: float = PIXELS_PER_DEGREE, **kwargs):
        super().__init__(region, **kwargs)
        require(pixels_per_degree > 0, "pixels_per_degree", "a positive number", pixels_per_degree)
        self.pixels_per_degree = pixels_per_degree
        self.map_key = ("flip", pixels_per_degree)

    def maps(self, image: Images, target: Images) -> Tensor:
        return flip_map(image, target, self.pixels_per_degree)

    def pool(self, maps: Tensor, mask: Masks) -> Float[Tensor, " n"]:
        return functional.mean_over(maps, self.region_of(mask))


class LPIPS(PerImageMetric):
    """LPIPS of the whole image by torchmetrics, which needs torchvision and its weights.

    Args:
        net: ``vgg``, ``alex`` or ``squeeze``.
        signed: map [0, 1] to [-1, 1], for which the network was calibrated; the authors' evaluation does not.
        kwargs: of :class:`PerImageMetric`.

    Raises:
        InputError: torchvision or the weights are not available.
    """

    higher_is_better = False

    def __init__(self, net: str = "vgg", signed: bool = True, **kwargs):
        super().__init__(**kwargs)
        choice("lpips.net", net, ("vgg", "alex", "squeeze"))
        try:
            import torchvision  # noqa: F401
        except ImportError as error:
            raise InputError("LPIPS needs torchvision: pip install 'ghgs-lit[lpips]'") from error
        from torchmetrics.image.lpip import LearnedPerceptualImagePatchSimilarity

        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                self.network = LearnedPerceptualImagePatchSimilarity(net_type=net, normalize=signed)
        except Exception as error:  # a download can fail in many ways
            reason = " ".join(str(error).split())
            raise InputError(f"LPIPS: the weights of {net!r} could not be loaded: {reason}") from error
        self.net, self.signed, self.map_key = net, signed, ("lpips", net, signed)

    def maps(self, image: Images, target: Images) -> Tensor:
        # With ``signed`` the network refuses values outside [0, 1], which renders can have.
        low, high = (0, 1) if self.signed else (-1, None)
        singles = (images.float().clamp(low, high).split(1) for images in (image, target))
        return torch.stack([self.network(a, b) for a, b in zip(*singles, strict=True)])

    def pool(self, maps: Tensor, mask: Masks) -> Float[Tensor, " n"]:
        return maps
