"""LPIPS by torchmetrics, which needs torchvision and its weights."""

import warnings

import torch
from jaxtyping import Float
from torch import Tensor

from ghgs_lit.errors import InputError, installed

NETWORK = "vgg"


class LPIPS:
    """LPIPS of whole images: one value for each. ``signed``: map [0, 1] to [-1, 1], for which the network was
    calibrated; the authors' evaluation does not. InputError: torchvision or the weights are not available."""

    def __init__(self, signed: bool = True):
        installed("torchvision", "lpips", "LPIPS")
        from torchmetrics.image.lpip import LearnedPerceptualImagePatchSimilarity

        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                self.network = LearnedPerceptualImagePatchSimilarity(net_type=NETWORK, normalize=signed)
        except Exception as error:  # a download can fail in many ways
            reason = " ".join(str(error).split())
            raise InputError(f"LPIPS: the weights of {NETWORK!r} could not be loaded: {reason}") from error
        self.signed = signed

    def __call__(
        self, image: Float[Tensor, "n 3 h w"], target: Float[Tensor, "n 3 h w"]
    ) -> Float[Tensor, " n"]:
        # With ``signed`` the network refuses values outside [0, 1], which renders can have.
        low, high = (0, 1) if self.signed else (-1, None)
        singles = (images.float().clamp(low, high).split(1) for images in (image, target))
        return torch.stack([self.network(a, b) for a, b in zip(*singles, strict=True)])
