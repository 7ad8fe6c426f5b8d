"""From normalised pictures to patch tokens by convolution: one linear patch, or a small stem."""

import torch.nn.functional as F
from einops import rearrange
from jaxtyping import Float
from torch import Tensor, nn


class PatchEmbed(nn.Module):
    """One convolution whose kernel is a patch."""

    def __init__(self, in_channels: int, width: int, patch_size: int):
        super().__init__()
        self.proj = nn.Conv2d(in_channels, width, kernel_size=patch_size, stride=patch_size)

    def forward(self, images: Float[Tensor, "n i H W"]) -> Float[Tensor, "n p c"]:
        return rearrange(self.proj(images), "n c h w -> n (h w) c")


class ChannelNorm(nn.LayerNorm):
    """LayerNorm over the channels of a map ``[n, c, h, w]``."""

    def forward(self, x: Float[Tensor, "n c h w"]) -> Float[Tensor, "n c h w"]:
        return super().forward(x.permute(0, 2, 3, 1)).permute(0, 3, 1, 2)


class ConvStem(nn.Module):
    """Halve while the patch size is even, take the odd rest in one strided convolution, mix neighbours.

    A few overlapping convolutions let a small encoder that is trained from scratch see edges and the
    silhouette much sooner than a linear patch does.
    """

    def __init__(self, in_channels: int, width: int, patch_size: int, channels: int):
        super().__init__()
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

    def forward(self, images: Float[Tensor, "n i H W"]) -> Float[Tensor, "n p c"]:
        x = self.reduce(images)
        x = x + self.mix(F.gelu(self.mix_norm(x)))
        return self.norm(rearrange(x, "n c h w -> n (h w) c"))
