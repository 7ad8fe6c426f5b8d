"""Recalibration of latent embeddings by multi-view semantic consistency (paper, section 3.3)."""

import dataclasses

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from ghgs_lit.errors import choice, require
from ghgs_lit.geometry.projection import at_least_float32
from ghgs_lit.geometry.vectors import unit
from ghgs_lit.kernels.linear import linear
from ghgs_lit.kernels.parts import at_once, even_parts
from ghgs_lit.recalibration import cpu
from ghgs_lit.recalibration.attention import SemanticAttention
from ghgs_lit.recalibration.neighbors import MODES, Neighbors, nearest_neighbors, widened
from ghgs_lit.types import Points, Tokens, true_places

#: Number of cosines that are held at once (bounds memory).
_COSINES, _GPU_COSINES = 1 << 21, 1 << 25

NEIGHBORHOODS = ("xyz", "image_plane", "feature")


class Recalibration(nn.Module):
    """One :class:`SemanticAttention` for all layers; neighbours and cosines are computed once per forward.

    Args:
        dim_latent: width of the tokens (from the encoder).
        k: neighbours of a token, or all there are if they are fewer.
        num_heads: see :class:`SemanticAttention`.
        similarity: see :class:`SemanticAttention`.
        s_min: see :class:`SemanticAttention`.
        neighborhood: where distances are measured: ``xyz``, between token points; ``image_plane``, between
            token centres in pixels, as if all views were one (the paper without
            unprojection); ``feature``, between directions of the semantic features.
        neighbors: from which views: ``all``, ``other_views`` or ``mixed`` (see :func:`nearest_neighbors`).
        tokens: which tokens take part: ``subject``, those with a valid point, others pass unchanged; ``all``,
            as in the release.
    """

    def __init__(
        self,
        dim_latent: int,
        k: int = 64,
        num_heads: int = 8,
        similarity: str = "product",
        s_min: float = 0.01,
        neighborhood: str = "xyz",
        neighbors: str = "all",
        tokens: str = "subject",
    ):
        super().__init__()
        require(isinstance(k, int) and k >= 1, "recalibration.k", "1 or more", k)
        choice("recalibration.neighborhood", neighborhood, NEIGHBORHOODS)
        choice("recalibration.neighbors", neighbors, MODES)
        choice("recalibration.tokens", tokens, ("subject", "all"))
        self.k, self.neighborhood, self.neighbors, self.tokens = k, neighborhood, neighbors, tokens
        self.block = SemanticAttention(dim_latent, num_heads, similarity, s_min)

    def forward(self, tokens: Tokens, points: Points) -> Tokens:
        """Tokens with recalibrated layers; the semantic features and the order stay.

        Args:
            tokens: from the encoder.
            points: of the same tokens.
        """
        batch_size, views = tokens.grid[:2]
        takes_part = self.takes_part(points)
        elements = torch.arange(batch_size, device=takes_part.device)[:, None]
        counts = ((tokens.image // views == elements) & takes_part).sum(1).tolist()
        chosen = true_places(takes_part, sum(counts))

        def part(values: Tensor) -> Tensor:
            return values if len(chosen) == len(values) else values[chosen]

        image = part(tokens.image)
        places = self.places(tokens)
        neighbors = [
            nearest_neighbors(positions, views_of, self.k, self.neighbors, places_of)
            for positions, views_of, places_of in zip(
                part(self.positions(tokens, points)).split(counts),
                image.split(counts),
                [None] * batch_size if places is None else part(places).split(counts),
                strict=True,
            )
        ]
        cosines = None
        if self.block.similarity != "none":
            semantic = part(tokens.semantic).split(counts)
            cosines = [neighbor_cosines(*pair) for pair in zip(semantic, neighbors, strict=True)]
        if takes_part.device.type != "cpu" and batch_size > 1:  # fewer calls
            neighbors = [Neighbors.join(neighbors)]
            k = neighbors[0].index.shape[1]
            cosines = cosines and [torch.cat([widened(found, k) for found in cosines])]
        layers = []
        for layer in tokens.latent:
            found = self.block(part(layer), neighbors, cosines).to(layer.dtype)
            layers.append(found if len(found) == len(layer) else layer.index_copy(0, chosen, found))
        return dataclasses.replace(tokens, latent=tuple(layers))

    def takes_part(self, points: Points) -> Bool[Tensor, " N"]:
        """Which tokens are recalibrated and can be neighbours."""
        return points.tokens_valid | (self.tokens == "all")

    def positions(self, tokens: Tokens, points: Points) -> Float[Tensor, "N d"]:
        """Position of each token in the space where neighbours are searched; see ``neighborhood``."""
        if self.neighborhood == "xyz":
            return points.tokens.detach()
        if self.neighborhood == "feature":
            return unit(tokens.semantic)
        # Half pixels are exact in float32, so that equal distances are equal numbers.
        return (torch.stack((tokens.row, tokens.column), dim=-1) + 0.5) * tokens.patch_size

    def places(self, tokens: Tokens) -> Int[Tensor, " N"] | None:
        """The ``places`` of :func:`nearest_neighbors`; None where equal distances are an accident."""
        if self.neighborhood != "image_plane":
            return None
        # Twice the columns: no two places at equal distances from a third have equal numbers apart from it.
        return tokens.row * 2 * tokens.grid[3] + tokens.column


@torch.no_grad()
def neighbor_cosines(semantic: Float[Tensor, "n s"], neighbors: Neighbors) -> Float[Tensor, "n k"]:
    """Cosines of the semantic features of tokens and their neighbours (Eq. 4), float32 or wider.

    Features are normalised once, before the neighbours are gathered. A feature of length 0 has cosine 0 with
    every other.
    """
    with torch.autocast(semantic.device.type, enabled=False):
        semantic = at_least_float32(semantic)
        if cpu.is_supported(semantic, 1, neighbors.index.shape[1]):
            return cpu.cosines(semantic, neighbors.index)
        # Allocated first: after the features it would keep their memory occupied once they are freed.
        cosines = semantic.new_empty(neighbors.index.shape)
        directions = unit(semantic)
        most = at_once(semantic.device, _COSINES, _GPU_COSINES)
        for rows in even_parts(len(directions), most // max(1, len(directions))):
            torch.gather(linear(directions[rows], directions), 1, neighbors.index[rows], out=cosines[rows])
    return cosines
