"""The encoder stage: input views and masks to tokens, by alternating attention within and across
views."""

import re
from collections.abc import Iterator
from contextlib import nullcontext
from typing import Literal

import torch
from jaxtyping import Bool, Float
from pydantic import Field, model_validator
from torch import Tensor, nn

from ghgs_lit.config.options import Count, Options, Side, Text, Width
from ghgs_lit.errors import require
from ghgs_lit.geometry.masks import (
    BOUNDS_CHANNELS,
    patches_around_subject,
    patches_in_window,
    relative_bounds,
)
from ghgs_lit.geometry.precision import bfloat16_where_possible
from ghgs_lit.geometry.projection import at_least_float32
from ghgs_lit.method.encoder.block import REGISTERS, Block, draw_normal_, rotary_tables, run_block
from ghgs_lit.method.encoder.semantic import PARTS, SemanticOptions
from ghgs_lit.method.encoder.vit import ConvStem, PatchEmbed, VisionTransformer
from ghgs_lit.method.plan import Plan, make_plan
from ghgs_lit.method.plan.patches import KeptPatches
from ghgs_lit.types import DepthBounds, Tokens

#: Fields of each kind of patch embedding.
_FIELDS = {"conv": (), "stem": ("channels",), "dinov2": ("depth", "heads")}


class PatchOptions(Options):
    """Images to patch tokens."""

    group = "encoder.vit"
    kind: Literal["conv", "stem", "dinov2"]
    """conv: one convolution per patch | stem: a small convolutional stem | dinov2: a ViT with registers"""
    channels: Width | None = None
    """kind=stem: channels after the first convolution; doubled at each halving, up to the width"""
    depth: Count | None = Field(None, le=1024)
    """kind=dinov2: number of blocks"""
    heads: Width | None = None
    """kind=dinov2: attention heads of each block"""

    @model_validator(mode="after")
    def _fields_are_those_of_the_kind(self) -> "PatchOptions":
        for name in ("channels", "depth", "heads"):
            if name in _FIELDS[self.kind]:
                self.require(getattr(self, name) is not None, name, f"a number with kind={self.kind}")
            else:
                self.require(getattr(self, name) is None, name, f"null with kind={self.kind}")
        return self


class VGGTOptions(Options):
    """VGGT encoder of any size: input views and masks to tokens."""

    group = "encoder"
    width: Width
    """Channels of the aggregator's tokens; a multiple of 4 * heads"""
    heads: Width
    """Attention heads of the aggregator's blocks"""
    depth: int = Field(ge=1, le=1024)
    """Number of pairs of a frame block and a global block"""
    layers: tuple[int, ...]
    """Indices of the pairs whose tokens are read out, ascending; the last pair must be included"""
    vit: PatchOptions
    """Patch embedding: images to patch tokens"""
    patch_size: int = Field(14, ge=1, le=1024)
    """Side of a patch in pixels"""
    image_size: Side = 518
    """Side in pixels of the square image for which a DINOv2 ViT stores position embeddings; a multiple
    of patch_size"""
    mask_input: bool = False
    """true: the mask is an additional input channel"""
    bounds_input: bool = False
    """true: near and far are two additional input channels (not with bounds.kind=none)"""
    semantic: SemanticOptions | None = None
    """Semantic features: null, the patch tokens | otherwise those of a branch of blocks over single
    views, which `ghgs pretext` trains and which is frozen afterwards"""
    layer_scale: float = 0.01
    """Initial LayerScale of the aggregator; 0.01 as published"""
    trainable: Text = "all"
    """Trained weights: all | none | last_<n>, the last n pairs of blocks"""
    checkpointing: bool = False
    """true: recompute activations in the backward pass, to save memory"""
    precision: Literal["inherit", "bfloat16"] = "inherit"
    """Precision of the encoder's products: inherit, as the whole model (the paper's tables: float32) |
    bfloat16, where the device has it: half the time on a GPU (the authors used float16)"""
    weights: Text | None = None
    """Published weights that the semantic features come from, or pretext; written by ghgs import and
    ghgs pretext, for tables only"""

    @model_validator(mode="after")
    def _parts_fit(self) -> "VGGTOptions":
        fits = self.width % (4 * self.heads) == 0
        self.require(fits, "width", "a multiple of 4 * heads (rows and columns rotate)")
        if self.vit.kind == "dinov2":
            heads = self.vit.heads
            patch = self.patch_size
            self.require(self.width % heads == 0, "width", f"a multiple of vit.heads={heads}")
            self.require(self.image_size % patch == 0, "image_size", f"a multiple of {patch}")
        layers = list(self.layers)
        last = self.depth - 1
        fits = bool(layers) and sorted(set(layers)) == layers and layers[0] >= 0 and layers[-1] == last
        expected = f"ascending indices that end at the last of {self.depth} pairs of blocks"
        self.require(fits, "layers", expected)
        match = re.fullmatch(r"all|none|last_(\d+)", self.trainable)
        fits = match is not None and int(match[1] or 0) <= self.depth
        self.require(fits, "trainable", f"all, none or last_<n>, n up to {self.depth}")
        return self

    def build(self, tokens: str = "all", margin: int = 1) -> "VGGTEncoder":
        """Build the stage with new weights; arguments as for :class:`VGGTEncoder`."""
        return VGGTEncoder(self, tokens, margin)


NORM_EPS = 1e-5

#: Tokens after a frame block and after the global block that follows it.
Pair = tuple[Float[Tensor, "t c"], Float[Tensor, "t c"]]


class Aggregator(nn.Module):
    """Pairs of a frame block and a global block on patch tokens (VGGT, Wang et al., CVPR 2025).

    Each view's sequence is [camera, registers, kept patches]. The first view has camera and register
    tokens of its own and thus defines the frame of reference: choosing another first view changes the
    result, any other permutation of the views only permutes it.

    Args:
        patch_embed: images [n, i, H, W] and :class:`KeptPatches` to tokens [N, width].
        options: width, heads, depth and read-out layers.
    """

    def __init__(self, patch_embed: nn.Module, options: VGGTOptions):
        super().__init__()
        width = options.width
        heads = options.heads
        self.patch_size = options.patch_size
        self.layers = options.layers
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

        self.frame_blocks = blocks()
        self.global_blocks = blocks()

    def forward(
        self, images: Float[Tensor, "b v i H W"], kept: KeptPatches
    ) -> tuple[list[Pair], Float[Tensor, "N c"]]:
        """Tokens after the blocks of each read-out layer.

        Args:
            images: [b, v, i, H, W], inputs of ``patch_embed``.
            kept: patches to encode; all others have no influence.

        Returns:
            Packed tokens [t, c], special ones included, after the frame block and after the global
            block of each layer in ``layers``; and the patch tokens [N, c] before the first block.
        """
        b, v = images.shape[:2]
        patches = self.patch_embed(images.flatten(0, 1), kept)
        # Camera and register tokens: index 0 for the first view, index 1 for all others.
        tokens = torch.cat((self.camera_token, self.register_token), dim=2)[0]
        special = torch.cat((tokens[:1], tokens[1:].expand(v - 1, -1, -1)))
        special = special.to(patches.dtype).repeat(b, 1, 1)
        x = kept.join(special, patches)
        rotary = rotary_tables(kept.positions(self.special), self.head_width, x)
        inside = kept.lengths(self.special)
        across = kept.element_lengths(self.special)
        real = kept.real_tokens(self.special)

        pairs = []
        blocks = zip(self.frame_blocks, self.global_blocks, strict=True)
        for i, (frame_block, global_block) in enumerate(blocks):
            frame = run_block(frame_block, x, inside, self.checkpointing, rotary, real)
            x = run_block(global_block, frame, across, self.checkpointing, rotary, real)
            if i in self.layers:
                pairs.append((frame, x))
        return pairs, patches


IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)

#: Values of ``skip.tokens`` that drop patches.
KEPT = {"window": patches_in_window, "subject": patches_around_subject}


class VGGTEncoder(nn.Module):
    """VGGT of any size: ``vggt_1b`` loads the published weights, smaller ones train from scratch.

    Args:
        options: options of the encoder.
        tokens: ``all``; ``window``: patches of the subject's bounding box; ``subject``: patches with
            a pixel of the subject. All others are dropped before the first block. Kept patches keep
            their positions; a view with an empty mask has its special tokens only.
        margin: number of patches around these that are kept, too.
    """

    def __init__(self, options: VGGTOptions, tokens: str = "all", margin: int = 1):
        super().__init__()
        self.options = options
        self.tokens = tokens
        self.margin = margin
        self.patch_size = options.patch_size
        self.dim_latent = 2 * options.width
        self.mask_input = options.mask_input
        self.bounds_input = options.bounds_input
        self.precision = options.precision
        extra = [0.5] * self.mask_input
        # Not in checkpoints, so they must be allocated even in a model built on the meta device.
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

    @property
    def keeps_features(self) -> bool:
        """Whether tokens are read from disk in training, which rules out CUDA-graph capture."""
        return getattr(self.aggregator.patch_embed, "cache", None) is not None

    def forward(
        self,
        images: Float[Tensor, "b v c H W"],
        masks: Bool[Tensor, "..."],
        bounds: DepthBounds | None = None,
        plan: Plan | None = None,
    ) -> Tokens:
        """Tokens of the patches ``plan.kept`` of all views.

        Args:
            images: [b, v, 3, H, W] in [0, 1], with sides divisible by the patch size.
            masks: [b, v, H, W]; used with ``mask_input``, ``bounds_input`` or ``semantic``, or
                without a plan.
            bounds: in metres; used with ``bounds_input``.
            plan: plan of the batch; None: one for the patches of :meth:`keeps`.

        Returns:
            Packed tokens with the layers of :attr:`VGGTOptions.layers`.

        Raises:
            InputError: images are float64 but weights are not.
        """
        narrow = images.dtype != torch.float64 or self.aggregator.camera_token.dtype == torch.float64
        require(narrow, "images", "float32 where the weights are no float64", images.dtype)
        plan = make_plan(masks, self.patch_size, self.keeps(masks)) if plan is None else plan
        kept = plan.kept
        with bfloat16_where_possible(images.device) if self.precision == "bfloat16" else nullcontext():
            pairs, patches = self.aggregator(self._normalize(images, masks, bounds), kept)
        latent = tuple(_join_pairs(pairs, kept, self.aggregator.special))
        semantic = patches.detach() if self.semantic is None else self.semantic(images, masks, plan)
        places = (kept.image, kept.row, kept.column)
        return Tokens(latent, semantic, *places, kept.grid, self.patch_size, kept.real)

    def keeps(self, masks: Bool[Tensor, "b v H W"]) -> Bool[Tensor, "b v h w"]:
        """Select the patches to keep according to ``tokens`` and ``margin``; on the CPU with
        ``tokens="all"``, which does not depend on the masks."""
        if self.tokens in KEPT:
            return KEPT[self.tokens](masks, self.patch_size, self.margin)
        b, v, height, width = masks.shape
        grid = (b, v, height // self.patch_size, width // self.patch_size)
        return torch.ones(grid, dtype=torch.bool, device="cpu")

    def _normalize(self, images: Tensor, masks: Tensor, bounds: DepthBounds | None) -> Tensor:
        x = at_least_float32(images)
        if self.mask_input:
            x = torch.cat((x, masks.to(x.dtype)[:, :, None]), dim=2)
        x = (x - self.mean) / self.std
        if self.bounds_input:
            x = torch.cat((x, relative_bounds(bounds, masks).to(x.dtype)), dim=2)
        return x.to(self.aggregator.camera_token.dtype)


def _join_pairs(pairs: list[Pair], kept: KeptPatches, special: int) -> Iterator[Float[Tensor, "N C"]]:
    """Concatenate the patch tokens of both blocks of each layer (C = 2 c); empties ``pairs`` to free
    memory."""
    while pairs:
        yield torch.cat([kept.take(tokens, special) for tokens in pairs.pop(0)], dim=-1)


def _patch_embedding(options: VGGTOptions, channels: int) -> nn.Module:
    vit = options.vit
    width = options.width
    patch_size = options.patch_size
    if vit.kind == "conv":
        return PatchEmbed(channels, width, patch_size)
    if vit.kind == "stem":
        return ConvStem(channels, width, patch_size, vit.channels)
    return VisionTransformer(
        channels, width, vit.depth, vit.heads, patch_size, options.image_size, options.checkpointing
    )
