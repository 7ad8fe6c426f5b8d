"""Alternating attention inside each view and across all views (VGGT's aggregator)."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from ghgs_lit.encoder.block import REGISTERS, Block, draw_normal_, rotary_tables, run_block
from ghgs_lit.encoder.options import VGGTSettings
from ghgs_lit.encoder.packing import KeptPatches

NORM_EPS = 1e-5

#: Tokens after a frame block and after the global block that follows it.
Pair = tuple[Float[Tensor, "t c"], Float[Tensor, "t c"]]


class Aggregator(nn.Module):
    """``depth`` pairs of a frame block and a global block on the patch tokens of ``patch_embed``.

    Each view's sequence is [camera, registers, kept patches]. The first view has its own camera and register
    tokens, so it defines the frame of reference: another first view changes the result; any other permutation
    of the views only permutes it. ``patch_embed``: [n, i, H, W] images and :class:`KeptPatches` to [N, width]
    tokens of the kept patches. ``options``: of the stage.
    """

    def __init__(self, patch_embed: nn.Module, options: VGGTSettings):
        super().__init__()
        width, heads = options.width, options.heads
        self.patch_size, self.layers = options.patch_size, options.layers
        self.checkpointing = options.checkpointing
        self.special = 1 + REGISTERS
        self.head_width = width // heads
        self.patch_embed = patch_embed
        self.camera_token = nn.Parameter(draw_normal_(torch.empty(1, 2, 1, width), 1e-6))
        self.register_token = nn.Parameter(draw_normal_(torch.empty(1, 2, REGISTERS, width), 1e-6))

        def blocks() -> nn.ModuleList:
            return nn.ModuleList(
                Block(width, heads, qk_norm=True, norm_eps=NORM_EPS, layer_scale=options.layer_scale)
                for _ in range(options.depth)
            )

        self.frame_blocks, self.global_blocks = blocks(), blocks()

    def forward(
        self, images: Float[Tensor, "b v i H W"], kept: KeptPatches
    ) -> tuple[list[Pair], Float[Tensor, "N c"]]:
        """Tokens of the layers that are read out. Returns: For each layer in ``layers`` the packed tokens
        after its frame block and after its global block, special tokens included; and the patch tokens that
        entered. ``kept``: the patches that take part; all others are as if they did not exist."""
        b, v = images.shape[:2]
        patches = self.patch_embed(images.flatten(0, 1), kept)
        # Camera and register tokens: number 0 for the first view, number 1 for all others.
        tokens = torch.cat((self.camera_token, self.register_token), dim=2)[0]
        special = torch.cat((tokens[:1], tokens[1:].expand(v - 1, -1, -1)))
        special = special.to(patches.dtype).repeat(b, 1, 1)
        x = kept.join(special, patches)
        rotary = rotary_tables(kept.positions(self.special), self.head_width, x)
        inside, across = kept.lengths(self.special), kept.element_lengths(self.special)

        pairs, blocks = [], zip(self.frame_blocks, self.global_blocks, strict=True)
        for i, (frame_block, global_block) in enumerate(blocks):
            frame = run_block(frame_block, x, inside, self.checkpointing, rotary)
            x = run_block(global_block, frame, across, self.checkpointing, rotary)
            if i in self.layers:
                pairs.append((frame, x))
        return pairs, patches
