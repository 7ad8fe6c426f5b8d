"""The encode stage: photographs and masks to tokens, by alternating attention inside and across views."""

from collections.abc import Iterator

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from ghgs_lit.encoder.block import REGISTERS, Block, draw_normal_, rotary_tables, run_block
from ghgs_lit.encoder.options import VGGTOptions
from ghgs_lit.encoder.packing import KeptPatches
from ghgs_lit.encoder.semantic import PARTS
from ghgs_lit.encoder.vit import ConvStem, PatchEmbed, VisionTransformer
from ghgs_lit.errors import require
from ghgs_lit.geometry.masks import (
    BOUNDS_CHANNELS,
    patches_around_subject,
    patches_in_window,
    relative_bounds,
)
from ghgs_lit.geometry.projection import at_least_float32
from ghgs_lit.types import DepthBounds, Tokens

NORM_EPS = 1e-5

#: Tokens after a frame block and after the global block that follows it.
Pair = tuple[Float[Tensor, "t c"], Float[Tensor, "t c"]]


class Aggregator(nn.Module):
    """``depth`` pairs of a frame block and a global block on the patch tokens of ``patch_embed``.

    Each view's sequence is [camera, registers, kept patches]. The first view has its own camera and register
    tokens, so it defines the frame of reference: another first view changes the result; any other permutation
    of the views only permutes it. ``patch_embed``: images [n, i, H, W] and :class:`KeptPatches` to tokens
    [N, width]."""

    def __init__(self, patch_embed: nn.Module, options: VGGTOptions):
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
        """Packed tokens, special ones included, after the frame block and after the global block of each
        layer in ``layers``; and the patch tokens before the first block. ``kept``: the patches that take
        part; all others are as if they did not exist."""
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


IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)

#: Choices of ``skip.tokens`` that leave patches out.
KEPT = {"window": patches_in_window, "subject": patches_around_subject}


class VGGTEncoder(nn.Module):
    """VGGT of any size: ``vggt_1b`` takes the published weights, smaller ones train from scratch.

    Args:
        tokens: ``all``; ``window``: patches of the smallest rectangle that holds the subject; ``subject``:
            patches with a pixel of the subject. Others leave before the first block. Kept patches keep their
            positions; a view with an empty mask has its special tokens only.
        margin: patches around these that are kept, too."""

    def __init__(self, options: VGGTOptions, tokens: str = "all", margin: int = 1):
        super().__init__()
        self.options, self.tokens, self.margin = options, tokens, margin
        self.patch_size, self.dim_latent = options.patch_size, 2 * options.width
        self.mask_input, self.bounds_input = options.mask_input, options.bounds_input
        extra = [0.5] * self.mask_input
        # Not in checkpoints, so they need storage even in a model that is built on the meta device.
        for name, values in (("mean", IMAGENET_MEAN), ("std", IMAGENET_STD)):
            constant = torch.tensor((*values, *extra), device="cpu").view(-1, 1, 1)
            self.register_buffer(name, constant, persistent=False)
        channels = len(self.mean) + BOUNDS_CHANNELS * self.bounds_input
        self.aggregator = Aggregator(_patch_embedding(options, channels), options)
        self._set_trainable(options.trainable, options.depth)
        branch = options.semantic
        self.semantic = None if branch is None else branch.build(options.patch_size).requires_grad_(False)
        self.dim_semantic = options.width if branch is None else PARTS

    def _set_trainable(self, trainable: str, depth: int) -> None:
        if trainable == "all":
            return
        count = 0 if trainable == "none" else int(trainable.removeprefix("last_"))
        self.requires_grad_(False)
        for blocks in (self.aggregator.frame_blocks, self.aggregator.global_blocks):
            blocks[depth - count :].requires_grad_(True)

    def forward(
        self,
        images: Float[Tensor, "b v c H W"],
        masks: Bool[Tensor, "..."],
        bounds: DepthBounds | None = None,
        kept: Bool[Tensor, "b v h w"] | None = None,
    ) -> Tokens:
        """Tokens of the kept patches of all views. ``images``: sides divisible by the patch size. ``masks``:
        read with ``mask_input``, ``bounds_input`` or ``semantic``, and where ``tokens`` is not ``all``.
        ``bounds``: read with ``bounds_input``. ``kept``: None: the patches of :meth:`keeps`."""
        narrow = images.dtype != torch.float64 or self.aggregator.camera_token.dtype == torch.float64
        require(narrow, "images", "float32 where the weights are no float64", images.dtype)
        chosen = self.keeps(masks) if kept is None else kept
        kept = KeptPatches(chosen, images.device)
        pairs, patches = self.aggregator(self._normalized(images, masks, bounds), kept)
        latent = tuple(_joined(pairs, kept, self.aggregator.special))
        semantic = patches.detach() if self.semantic is None else self.semantic(images, masks, chosen)
        places = (kept.image, kept.row, kept.column)
        return Tokens(latent, semantic, *places, kept.grid, self.patch_size)

    def keeps(self, masks: Bool[Tensor, "b v H W"]) -> Bool[Tensor, "b v h w"]:
        """Patches that ``tokens`` and ``margin`` keep; on the CPU where the masks are not read."""
        if self.tokens in KEPT:
            return KEPT[self.tokens](masks, self.patch_size, self.margin)
        b, v, height, width = masks.shape
        grid = (b, v, height // self.patch_size, width // self.patch_size)
        return torch.ones(grid, dtype=torch.bool, device="cpu")

    def _normalized(self, images: Tensor, masks: Tensor, bounds: DepthBounds | None) -> Tensor:
        x = at_least_float32(images)
        if self.mask_input:
            x = torch.cat((x, masks.to(x.dtype)[:, :, None]), dim=2)
        x = (x - self.mean) / self.std
        if self.bounds_input:
            x = torch.cat((x, relative_bounds(bounds, masks).to(x.dtype)), dim=2)
        return x.to(self.aggregator.camera_token.dtype)


def _joined(pairs: list[Pair], kept: KeptPatches, special: int) -> Iterator[Float[Tensor, "N C"]]:
    """Patch tokens of each frame and global block, concatenated; empties ``pairs`` to free memory."""
    while pairs:
        yield torch.cat([kept.take(tokens, special) for tokens in pairs.pop(0)], dim=-1)


def _patch_embedding(options: VGGTOptions, channels: int) -> nn.Module:
    vit, width, patch_size = options.vit, options.width, options.patch_size
    if vit.kind == "conv":
        return PatchEmbed(channels, width, patch_size)
    if vit.kind == "stem":
        return ConvStem(channels, width, patch_size, vit.channels)
    return VisionTransformer(
        channels, width, vit.depth, vit.heads, patch_size, options.image_size, options.checkpointing
    )
