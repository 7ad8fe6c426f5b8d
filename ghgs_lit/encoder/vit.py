"""DINOv2 vision transformer with registers: the semantic features F of the paper."""

import math

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from ghgs_lit.encoder.block import REGISTERS, Block, draw_normal_, run_block
from ghgs_lit.encoder.packing import KeptPatches
from ghgs_lit.encoder.patch import PatchEmbed

NORM_EPS = 1e-6


class VisionTransformer(nn.Module):
    """DINOv2 ViT; tokens of an image are in the order class, registers, kept patches.

    Args:
        image_size: side in pixels of the square image whose position embedding is stored, a multiple of
            ``patch_size``; for other sizes it is resampled.
        checkpointing: recompute activations in the backward pass instead of keeping them.
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
        self.patch_embed = PatchEmbed(in_channels, width, patch_size)
        self.cls_token = nn.Parameter(torch.zeros(1, 1, width))
        self.pos_embed = nn.Parameter(torch.zeros(1, 1 + (image_size // patch_size) ** 2, width))
        self.register_tokens = nn.Parameter(torch.zeros(1, REGISTERS, width))
        # Replaces masked patches in DINOv2's own training; kept so that its weights load strictly.
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
        """Position embedding of class and patches on ``height`` x ``width`` patches, resampled in float32."""
        side = math.isqrt(self.pos_embed.shape[1] - 1)
        if (height, width) == (side, side):
            return self.pos_embed.to(dtype)
        table = self.pos_embed.float()
        grid = table[:, 1:].unflatten(1, (side, side)).permute(0, 3, 1, 2)
        grid = F.interpolate(grid, (height, width), mode="bicubic", antialias=True, align_corners=False)
        return torch.cat((table[:, :1], grid.flatten(2).mT), dim=1).to(dtype)

    def embed(self, images: Float[Tensor, "n i H W"], kept: KeptPatches) -> Float[Tensor, "t c"]:
        """The packed input of the first block; position embeddings are those of the whole image."""
        n, _, height, width = images.shape
        patches = self.patch_embed.dense(images)
        positions = self.positions(height // self.patch_size, width // self.patch_size, patches.dtype)
        special = torch.cat((self.cls_token + positions[:, :1], self.register_tokens), dim=1)
        return kept.join(special.expand(n, -1, -1), kept.select(patches + positions[:, 1:]))

    def tokens(self, images: Float[Tensor, "n i H W"], kept: KeptPatches) -> Float[Tensor, "t c"]:
        """Packed class, register and patch tokens after the final norm."""
        x, lengths = self.embed(images, kept), kept.lengths(self.special)
        for block in self.blocks:
            x = run_block(block, x, lengths, self.checkpointing)
        return self.norm(x)

    def forward(self, images: Float[Tensor, "n i H W"], kept: KeptPatches) -> Float[Tensor, "N c"]:
        return kept.take(self.tokens(images, kept), self.special)
