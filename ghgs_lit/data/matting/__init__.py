"""Matting of images whose masks are a few pixels off, ragged, or have holes.

A mask that is off by a pixel adds colours of the background, which differ between views, to the
subject's outline. A network estimates the matte from the image and the mask: a U-Net (Ronneberger et
al., MICCAI 2015) whose inputs are the colours, the rough mask, as in Deep Image Matting (Xu et al.,
CVPR 2017), and the differences of each colour from nearby colours of the subject and the background. It
was trained on generated people in front of many kinds of backgrounds (by ``scripts/bake_matting.py`` of
commit 46b85d02).
"""

import functools
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, UInt8
from safetensors.torch import load_file
from torch import Tensor, nn

from ghgs_lit.geometry.masks import signed_distance
from ghgs_lit.geometry.precision import exact

#: Channels at the full size of the image and at each halving.
_WIDTHS = (16, 32, 48, 64)
#: Distance from the mask's outline, in pixels, at which it is clipped.
FARTHEST = 8.0
#: Nearby colours are averaged twice over squares of these sides, in images smaller by this factor.
_COARSER = 4
_SIDES = (3, 7)
#: Input channels: colours, mask, distance from its outline, and differences from nearby colours inside
#: and outside.
_FEATURES = 5 + 3 * 2 * len(_SIDES)


class MattingNetwork(nn.Module):
    """U-Net that predicts mattes and the subject's colours."""

    def __init__(self) -> None:
        super().__init__()
        self.down = nn.ModuleList(_convolutions(*pair) for pair in pairwise((_FEATURES, *_WIDTHS)))
        self.up = nn.ModuleList(_convolutions(fine + coarse, fine) for fine, coarse in pairwise(_WIDTHS))
        self.out = nn.Conv2d(_WIDTHS[0], 4, 1)

    def forward(
        self, images: Float[Tensor, "B 3 h w"], mattes: Float[Tensor, "B h w"]
    ) -> tuple[Float[Tensor, "B h w"], Float[Tensor, "B 3 h w"]]:
        """Predict mattes and premultiplied colours of the subject.

        Args:
            images: images with their background, in [0, 1].
            mattes: rough mattes in [0, 1], such as masks of 0 and 1.

        Returns:
            Mattes, and the subject's colours multiplied by them, in [0, 1].
        """
        height, width = images.shape[2:]
        whole = 2 ** (len(_WIDTHS) - 1)
        x = F.pad(_features(images, mattes), (0, -width % whole, 0, -height % whole), mode="replicate")
        finer = []
        for level, block in enumerate(self.down):
            x = block(F.avg_pool2d(x, 2) if level else x)
            finer.append(x)
        finer.pop()
        for block in reversed(self.up):
            x = block(torch.cat((finer.pop(), F.interpolate(x, scale_factor=2.0, mode="nearest")), 1))
        out = self.out(x)[..., :height, :width].float()
        # A correction of up to 1.1 can invert a mask.
        share = (mattes + 1.1 * torch.tanh(out[:, 0])).clamp(0, 1)
        # A pixel mixes the colours of subject and background; the network predicts their difference.
        colors = (images + (1 - share)[:, None] * out[:, 1:]).clamp(0, 1)
        return share, share[:, None] * colors


def _convolutions(before: int, after: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(before, after, 3, padding=1), nn.ReLU(), nn.Conv2d(after, after, 3, padding=1), nn.ReLU()
    )


def _features(
    images: Float[Tensor, "B 3 h w"], mattes: Float[Tensor, "B h w"]
) -> Float[Tensor, "B features h w"]:
    """Input channels of the network (:data:`_FEATURES`)."""
    with exact(images.device.type):
        inside = np.stack([_insideness(mask) for mask in (mattes > 0.5).cpu().numpy()])
        depth = torch.from_numpy(inside).to(images)[:, None]
        parts = [images - 0.5, mattes[:, None] - 0.5, depth]
        for side_of_outline in (depth, -depth):
            weight = side_of_outline.clamp(min=0) ** 2
            sums = torch.cat((images * weight, weight), 1)
            sums = F.avg_pool2d(sums, _COARSER, ceil_mode=True, count_include_pad=False)
            parts += [images - _near(sums, side, images.shape[2:]) for side in _SIDES]
        return torch.cat(parts, 1).contiguous(memory_format=torch.channels_last)


def _insideness(mask: np.ndarray) -> np.ndarray:
    """Signed distance from the outline divided by :data:`FARTHEST`, in [-1, 1], positive inside, float32."""
    return (signed_distance(mask) / FARTHEST).clip(-1, 1).astype(np.float32)


def _near(sums: Float[Tensor, "B 4 m n"], side: int, size: torch.Size) -> Float[Tensor, "B 3 h w"]:
    """Weighted means of nearby colours; black if all weights are 0."""
    for _ in range(2):
        sums = F.avg_pool2d(sums, side, 1, side // 2)
    means = sums[:, :3] / (sums[:, 3:] + 1e-4)
    return F.interpolate(means, size, mode="bilinear", align_corners=False)


#: The network's weights in half precision.
WEIGHTS = Path(__file__).with_name("weights.safetensors")
#: Context in pixels around those that may change.
_AROUND = 16


def refine_matte(
    image: UInt8[np.ndarray, "h w 3"], matte: UInt8[np.ndarray, "h w"], pixels: float
) -> tuple[UInt8[np.ndarray, "h w 3"], UInt8[np.ndarray, "h w"]]:
    """Refine a matte, and extract the subject on black.

    Args:
        image: image with its background; works best if the subject is 170 to 330 pixels tall, as in
            training.
        matte: 255 times the share of each pixel that shows the subject, such as a mask of 0 and 255.
        pixels: maximum error of the outline, above 0 (8 in training); holes of up to twice this width
            can be filled.

    Returns:
        Premultiplied image and refined matte, of the same sizes.
    """
    window = _window(matte > 127, int(pixels) + _AROUND)
    colors = torch.from_numpy(image[window] / np.float32(255))
    given = torch.from_numpy(matte[window] / np.float32(255))
    with torch.inference_mode():
        estimate, subject = _network()(colors.permute(2, 0, 1)[None], given[None])
    # Pixels close enough to the outline to change.
    is_open = np.abs(signed_distance(matte[window] > 127)) + 0.5 <= pixels
    result = np.zeros_like(image), np.zeros_like(matte)
    kept = given.numpy(), (given[..., None] * colors).numpy()
    alpha = np.where(is_open, estimate[0].numpy(), kept[0])
    premultiplied = np.where(is_open[..., None], subject[0].permute(1, 2, 0).numpy(), kept[1])
    for whole, part in zip(result, (premultiplied, alpha), strict=True):
        whole[window] = np.round(255 * part)
    return result


@functools.cache
def _network() -> MattingNetwork:
    network = MattingNetwork().eval()
    network.load_state_dict(load_file(WEIGHTS))
    return network.to(memory_format=torch.channels_last)


def _window(inside: Bool[np.ndarray, "h w"], margin: int) -> tuple[slice, slice]:
    """Box around the true pixels with a margin in pixels; the whole image if there are none."""
    lines = (np.nonzero(inside.any(axis))[0] for axis in (1, 0))
    return tuple(slice(max(n[0] - margin, 0), n[-1] + margin + 1) if len(n) else slice(None) for n in lines)
