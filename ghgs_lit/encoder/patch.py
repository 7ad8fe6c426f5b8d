"""Normalised images to patch tokens: one linear projection of each patch, or a small convolutional stem."""

import torch.nn.functional as F
from einops import rearrange
from jaxtyping import Float
from torch import Tensor, nn

from ghgs_lit.encoder.packing import KeptPatches


class PatchEmbed(nn.Module):
    """One convolution whose kernel and stride are the patch size (a linear projection of each patch)."""

    def __init__(self, in_channels: int, width: int, patch_size: int):
        super().__init__()
        self.proj = nn.Conv2d(in_channels, width, kernel_size=patch_size, stride=patch_size)

    def dense(self, images: Float[Tensor, "n i H W"]) -> Float[Tensor, "n p c"]:
        """Tokens of all patches, row by row."""
        return rearrange(self.proj(images), "n c h w -> n (h w) c")

    def forward(self, images: Float[Tensor, "n i H W"], kept: KeptPatches) -> Float[Tensor, "N c"]:
        return kept.select(self.dense(images))


class ChannelNorm(nn.LayerNorm):
    """LayerNorm over the channels of feature maps [n, c, h, w]."""

    def forward(self, x: Float[Tensor, "n c h w"]) -> Float[Tensor, "n c h w"]:
        return super().forward(x.permute(0, 2, 3, 1)).permute(0, 3, 1, 2)


#: Patches around those that are kept, on which these depend: one is mixed in, it sees a part of the next.
_REACH = 2


class ConvStem(nn.Module):
    """Overlapping convolutions: with them a small encoder learns edges and the silhouette much sooner.

    The image is halved while the patch size is even; one strided convolution does the odd remainder; a last
    convolution mixes neighbouring patches. ``channels``: channels after the first convolution; doubled at
    each halving, up to ``width``.
    """

    def __init__(self, in_channels: int, width: int, patch_size: int, channels: int):
        super().__init__()
        self.patch_size = patch_size
        layers, rest, outputs = [], patch_size, min(channels, width)
        while rest % 2 == 0:
            layers += [
                nn.Conv2d(in_channels, outputs, 3, stride=2, padding=1),
                ChannelNorm(outputs),
                nn.GELU(),
            ]
            in_channels, outputs, rest = outputs, min(2 * outputs, width), rest // 2
        self.reduce = nn.Sequential(*layers, nn.Conv2d(in_channels, width, rest, stride=rest))
        self.mix_norm = ChannelNorm(width)
        self.mix = nn.Conv2d(width, width, 3, padding=1)
        self.norm = nn.LayerNorm(width)

    def forward(self, images: Float[Tensor, "n i H W"], kept: KeptPatches) -> Float[Tensor, "N c"]:
        p, (rows, columns) = self.patch_size, kept.box(_REACH)
        x = self.reduce(images[..., p * rows.start : p * rows.stop, p * columns.start : p * columns.stop])
        x = x + self.mix(F.gelu(self.mix_norm(x)))
        return self.norm(x.movedim(1, -1)[kept.image, kept.row - rows.start, kept.column - columns.start])
