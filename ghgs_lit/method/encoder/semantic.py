"""Semantic features F of encoders without published weights: body parts visible in a patch."""

import torch
from jaxtyping import Bool, Float
from pydantic import Field, model_validator
from torch import Tensor, nn

from ghgs_lit.config.options import Options, Width
from ghgs_lit.geometry.masks import patches_around_subject
from ghgs_lit.geometry.projection import at_least_float32
from ghgs_lit.method.encoder.block import Block, draw_normal_, rotary_tables, run_block
from ghgs_lit.method.encoder.vit import ConvStem
from ghgs_lit.method.plan import Plan
from ghgs_lit.method.plan.patches import KeptPatches

NORM_EPS = 1e-5
#: Number of body parts that ``ghgs pretext`` distinguishes, and of channels of a feature.
PARTS = 16


class SemanticOptions(Options):
    """A branch of blocks over single views, whose features distinguish body parts."""

    group = "encoder.semantic"
    width: Width = 64
    """Channels of the blocks; a multiple of 4 * heads"""
    depth: int = Field(3, ge=1, le=1024)
    """Number of blocks"""
    heads: Width = 2
    """Attention heads of each block"""
    channels: Width = 24
    """Channels of the stem after its first convolution"""

    @model_validator(mode="after")
    def _heads_rotate(self) -> "SemanticOptions":
        fits = self.width % (4 * self.heads) == 0
        self.require(fits, "width", "a multiple of 4 * heads (rows and columns rotate)")
        return self

    def build(self, patch_size: int) -> "SemanticBranch":
        """Build the branch for patches of ``patch_size`` pixels."""
        return SemanticBranch(self, patch_size)


def features_of(log_shares: Float[Tensor, "N p"]) -> Float[Tensor, "N p"]:
    """Features of unit norm: square roots of the shares of parts in a patch.

    Their cosine is the overlap of two distributions (Bhattacharyya coefficient).
    """
    return (0.5 * log_shares).exp()


class SemanticBranch(nn.Module):
    """A stem and a few blocks over the subject's patches of one view; ``ghgs pretext`` trains it.

    Features are square roots of the predicted shares of the parts in a patch. Their cosine, the
    semantic consistency (Eq. 4), is the overlap of two distributions (Bhattacharyya coefficient): 1
    if they are equal, 0 if they share no part.

    Attention stays within a view, among a learned token and the patches with a pixel of the
    subject. Every value of ``skip.tokens`` keeps these, so features depend on one image and its mask
    alone."""

    def __init__(self, options: SemanticOptions, patch_size: int):
        super().__init__()
        width = options.width
        heads = options.heads
        self.parts = PARTS
        self.patch_size = patch_size
        self.head_width = width // heads
        self.stem = ConvStem(4, width, patch_size, options.channels)
        self.token = nn.Parameter(draw_normal_(torch.empty(1, 1, width), 0.02))
        self.blocks = nn.ModuleList(
            Block(width, heads, qk_norm=True, norm_eps=NORM_EPS, layer_scale=0.1)
            for _ in range(options.depth)
        )
        self.norm = nn.LayerNorm(width, eps=NORM_EPS)
        self.head = nn.Linear(width, self.parts)

    def subject(self, masks: Bool[Tensor, "b v H W"]) -> Bool[Tensor, "b v h w"]:
        """Select the patches that have features."""
        return patches_around_subject(masks, self.patch_size, margin=0)

    def log_shares(
        self, images: Float[Tensor, "b v c H W"], masks: Bool[Tensor, "b v H W"], kept: KeptPatches
    ) -> Float[Tensor, "N p"]:
        """Predict logarithms of the shares of parts in patches, in float32 or wider.

        Args:
            images: [b, v, 3, H, W] in [0, 1].
            masks: of the subject [b, v, H, W].
            kept: the patches of :meth:`subject`, or some of them.
        """
        x = torch.cat((images, masks[:, :, None].to(images.dtype)), dim=2).flatten(0, 1)
        patches = self.stem((2 * x - 1).to(self.token.dtype), kept)
        x = kept.join(self.token.to(patches.dtype).expand(masks.shape[0] * masks.shape[1], -1, -1), patches)
        rotary = rotary_tables(kept.positions(1), self.head_width, x)
        for block in self.blocks:
            x = run_block(block, x, kept.lengths(1), False, rotary, kept.real_tokens(1))
        return at_least_float32(self.head(self.norm(kept.take(x, 1)))).log_softmax(1)

    def forward(
        self, images: Float[Tensor, "b v c H W"], masks: Bool[Tensor, "b v H W"], plan: Plan
    ) -> Float[Tensor, "N p"]:
        """Features [N, p] of the patches ``plan.kept``; 0 (cosine 0 with all others) in those without the
        subject.

        Args:
            images: [b, v, 3, H, W] in [0, 1].
            masks: of the subject [b, v, H, W].
            plan: only its ``shown_patches`` are computed.
        """
        shown = plan.shown_patches
        features = features_of(self.log_shares(images, masks, shown))
        count = len(plan.kept.index)
        places = torch.searchsorted(plan.kept.index, shown.index)
        if shown.real is None:
            return features.new_zeros(count, self.parts).index_copy(0, places, features)
        places = torch.where(shown.real, places, count)  # padding goes to an extra row
        return features.new_zeros(count + 1, self.parts).index_copy(0, places, features)[:count]
