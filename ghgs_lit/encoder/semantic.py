"""Semantic features F of encoders without published weights: which parts of a body a patch shows."""

from collections.abc import Mapping

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from ghgs_lit.encoder.block import Block, draw_normal_, run_block
from ghgs_lit.encoder.packing import KeptPatches
from ghgs_lit.encoder.patch import ConvStem
from ghgs_lit.encoder.rope import rotary_tables
from ghgs_lit.errors import require
from ghgs_lit.geometry.masks import patches_around_subject
from ghgs_lit.geometry.projection import at_least_float32

NORM_EPS = 1e-5

#: Keys of ``encoder.semantic``.
OPTIONS = ("width", "depth", "heads", "channels", "parts")


def features_of(log_shares: Float[Tensor, "N p"]) -> Float[Tensor, "N p"]:
    """Square roots of shares, whose cosine is the overlap of two distributions."""
    return (0.5 * log_shares).exp()


class SemanticBranch(nn.Module):
    """A stem and a few blocks over the subject's patches of one view; ``ghgs pretext`` trains it.

    Features are square roots of the predicted shares of the parts in a patch. Their cosine, the semantic
    consistency (Eq. 4), is then the overlap of two distributions (Bhattacharyya's coefficient): 1 where they
    are equal, 0 where no part is shared.

    Attention is inside a view, among a learned token and the patches with a pixel of the subject. All
    choices of ``encoder.tokens`` keep these, so features are those of the photograph and its mask, whatever
    is kept beside them and whichever views there are.

    Args:
        patch_size: side of a patch in pixels.
        width: of the blocks.
        depth: number of blocks.
        heads: attention heads of each block.
        channels: of the stem (:class:`ConvStem`).
        parts: number of parts, which is that of a feature's channels.
    """

    def __init__(self, patch_size: int, width: int, depth: int, heads: int, channels: int, parts: int):
        super().__init__()
        expected = "a multiple of 4 * heads (rows and columns rotate)"
        require(width % (4 * heads) == 0, "encoder.semantic.width", expected, width)
        self.patch_size, self.parts, self.head_width = patch_size, parts, width // heads
        self.stem = ConvStem(4, width, patch_size, channels)
        self.token = nn.Parameter(draw_normal_(torch.empty(1, 1, width), 0.02))
        self.blocks = nn.ModuleList(
            Block(width, heads, qk_norm=True, norm_eps=NORM_EPS, layer_scale=0.1) for _ in range(depth)
        )
        self.norm = nn.LayerNorm(width, eps=NORM_EPS)
        self.head = nn.Linear(width, parts)

    @classmethod
    def of(cls, options: Mapping[str, int], patch_size: int) -> "SemanticBranch":
        """The branch that ``encoder.semantic`` describes.

        Raises:
            InputError: an option is missing, unknown or impossible (names it).
        """
        fits = set(options) == set(OPTIONS)
        require(fits, "encoder.semantic", f"null or a mapping of {', '.join(OPTIONS)}", sorted(options))
        return cls(patch_size, **options)

    def subject(self, masks: Bool[Tensor, "b v H W"]) -> Bool[Tensor, "b v h w"]:
        """The patches that have features."""
        return patches_around_subject(masks, self.patch_size, margin=0)

    def log_shares(
        self, images: Float[Tensor, "b v c H W"], masks: Bool[Tensor, "b v H W"], kept: KeptPatches
    ) -> Float[Tensor, "N p"]:
        """Logarithms of the shares of the parts in ``kept``, patches of :meth:`subject`; float32 or wider.

        Args:
            images: RGB in [0, 1].
            masks: of the subject.
            kept: all patches of the subject, unless a caller wants fewer.
        """
        x = torch.cat((images, masks[:, :, None].to(images.dtype)), dim=2).flatten(0, 1)
        patches = self.stem((2 * x - 1).to(self.token.dtype), kept)
        x = kept.join(self.token.to(patches.dtype).expand(masks.shape[0] * masks.shape[1], -1, -1), patches)
        rotary = rotary_tables(kept.positions(1), self.head_width, x)
        for block in self.blocks:
            x = run_block(block, x, kept.lengths(1), False, rotary)
        return at_least_float32(self.head(self.norm(kept.take(x, 1)))).log_softmax(1)

    def forward(
        self,
        images: Float[Tensor, "b v c H W"],
        masks: Bool[Tensor, "b v H W"],
        kept: Bool[Tensor, "b v h w"],
    ) -> Float[Tensor, "N p"]:
        """Features of the patches in ``kept``; 0 (cosine 0 with all others) where there is no subject."""
        every = KeptPatches(kept, images.device)
        own = KeptPatches(kept.to(masks.device) & self.subject(masks), images.device)
        features = features_of(self.log_shares(images, masks, own))
        places = torch.searchsorted(every.index, own.index)
        return features.new_zeros(len(every.index), self.parts).index_copy(0, places, features)
