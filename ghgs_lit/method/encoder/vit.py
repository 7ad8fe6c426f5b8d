"""Images to patch tokens: a projection of each patch, a convolutional stem, or DINOv2 with
registers, whose tokens are the semantic features F of the paper."""

import math
from collections.abc import Callable

import torch
import torch.nn.functional as F
from einops import rearrange
from jaxtyping import Float
from torch import Tensor, nn

from ghgs_lit.method.encoder.block import REGISTERS, Block, draw_normal_, run_block
from ghgs_lit.method.plan.patches import KeptPatches


class PatchEmbed(nn.Module):
    """Linear projection of each patch, as one convolution."""

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


#: Patches around a kept one that it depends on: adjacent patches are mixed in, whose receptive fields
#: reach into their neighbours.
_REACH = 2


class ConvStem(nn.Module):
    """Overlapping convolutions, with which a small encoder learns edges and the silhouette much sooner.

    Strided convolutions halve the image as long as the patch size is even, a last one covers the rest
    of the patch, and another mixes neighbouring patches.

    Args:
        in_channels: channels of the images.
        width: channels of a token.
        patch_size: side of a patch in pixels.
        channels: channels after the first convolution; doubled at each halving, up to ``width``.
    """

    def __init__(self, in_channels: int, width: int, patch_size: int, channels: int):
        super().__init__()
        self.patch_size = patch_size
        layers = []
        rest = patch_size
        outputs = min(channels, width)
        while rest % 2 == 0:
            halving = nn.Conv2d(in_channels, outputs, 3, stride=2, padding=1)
            layers += [halving, ChannelNorm(outputs), nn.GELU()]
            in_channels = outputs
            outputs = min(2 * outputs, width)
            rest = rest // 2
        self.reduce = nn.Sequential(*layers, nn.Conv2d(in_channels, width, rest, stride=rest))
        self.mix_norm = ChannelNorm(width)
        self.mix = nn.Conv2d(width, width, 3, padding=1)
        self.norm = nn.LayerNorm(width)

    def forward(self, images: Float[Tensor, "n i H W"], kept: KeptPatches) -> Float[Tensor, "N c"]:
        p = self.patch_size
        rows, columns = kept.box(_REACH)
        x = self.reduce(images[..., p * rows.start : p * rows.stop, p * columns.start : p * columns.stop])
        x = x + self.mix(F.gelu(self.mix_norm(x)))
        return self.norm(x.movedim(1, -1)[kept.image, kept.row - rows.start, kept.column - columns.start])


NORM_EPS = 1e-6


class VisionTransformer(nn.Module):
    """DINOv2 ViT with registers (Oquab et al., TMLR 2024; Darcet et al., ICLR 2024).

    Tokens of an image are in the order class, registers, kept patches.

    Args:
        in_channels: channels of the images.
        width: channels of a token.
        depth: number of blocks.
        heads: attention heads of each block, which divide ``width``.
        patch_size: side of a patch in pixels.
        image_size: side in pixels of the square image whose position embedding is stored, a
            multiple of ``patch_size``; it is resampled for other sizes.
        checkpointing: recompute activations in the backward pass.
    """

    def __init__(
        self,
        in_channels: int,
        width: int,
        depth: int,
        heads: int,
        patch_size: int,
        image_size: int,
        checkpointing: bool = False,
    ):
        super().__init__()
        self.patch_size = patch_size
        self.special = 1 + REGISTERS
        self.checkpointing = checkpointing
        #: ``cache(dense, images)`` returns tokens of cached images; None: all are computed.
        self.cache: Callable[..., Tensor] | None = None
        self.patch_embed = PatchEmbed(in_channels, width, patch_size)
        self.cls_token = nn.Parameter(torch.zeros(1, 1, width))
        self.pos_embed = nn.Parameter(torch.zeros(1, 1 + (image_size // patch_size) ** 2, width))
        self.register_tokens = nn.Parameter(torch.zeros(1, REGISTERS, width))
        # Used only in DINOv2's own training; kept so that its weights load strictly.
        self.mask_token = nn.Parameter(torch.zeros(1, width), requires_grad=False)
        self.blocks = nn.ModuleList(
            Block(width, heads, qk_norm=False, norm_eps=NORM_EPS, layer_scale=1.0) for _ in range(depth)
        )
        self.norm = nn.LayerNorm(width, eps=NORM_EPS)
        self.reset_parameters()

    def reset_parameters(self) -> None:
        for token in (self.cls_token, self.register_tokens):
            draw_normal_(token.detach(), 1e-6)
        nn.init.trunc_normal_(self.pos_embed, std=0.02)
        for module in self.modules():
            if isinstance(module, nn.Linear):
                nn.init.trunc_normal_(module.weight, std=0.02)
                nn.init.zeros_(module.bias)

    def positions(self, height: int, width: int, dtype: torch.dtype) -> Float[Tensor, "1 t c"]:
        """Position embeddings [1, 1 + height * width, c] of the class token and of ``height`` x ``width``
        patches, resampled in float32 and converted to ``dtype``."""
        side = math.isqrt(self.pos_embed.shape[1] - 1)
        if (height, width) == (side, side):
            return self.pos_embed.to(dtype)
        table = self.pos_embed.float()
        grid = table[:, 1:].unflatten(1, (side, side)).permute(0, 3, 1, 2)
        grid = F.interpolate(grid, (height, width), mode="bicubic", antialias=True, align_corners=False)
        return torch.cat((table[:, :1], grid.flatten(2).mT), dim=1).to(dtype)

    def embed(self, images: Float[Tensor, "n i H W"], kept: KeptPatches) -> Float[Tensor, "t c"]:
        """Packed class, register and patch tokens before the first block, with position embeddings of the
        whole image; sides of images must be divisible by the patch size."""
        n, _, height, width = images.shape
        patches = self.patch_embed.dense(images)
        positions = self.positions(height // self.patch_size, width // self.patch_size, patches.dtype)
        special = torch.cat((self.cls_token + positions[:, :1], self.register_tokens), dim=1)
        return kept.join(special.expand(n, -1, -1), kept.select(patches + positions[:, 1:]))

    def tokens(self, images: Float[Tensor, "n i H W"], kept: KeptPatches) -> Float[Tensor, "t c"]:
        """Packed class, register and patch tokens after the final norm."""
        x = self.embed(images, kept)
        lengths = kept.lengths(self.special)
        real = kept.real_tokens(self.special)
        for block in self.blocks:
            x = run_block(block, x, lengths, self.checkpointing, real=real)
        return self.norm(x)

    def forward(self, images: Float[Tensor, "n i H W"], kept: KeptPatches) -> Float[Tensor, "N c"]:
        if self.cache is not None and self.training and kept.is_whole:
            return self.cache(self.dense, images).flatten(0, 1)
        return kept.take(self.tokens(images, kept), self.special)

    def dense(self, images: Float[Tensor, "n i H W"]) -> Float[Tensor, "n p c"]:
        """Tokens of all patches of images, row by row."""
        grid = (len(images), 1, *(side // self.patch_size for side in images.shape[2:]))
        whole = KeptPatches.whole(grid, images.device)
        return whole.take(self.tokens(images, whole), self.special).unflatten(0, (len(images), -1))
