"""Recalibration of latent embeddings by multi-view semantic consistency (paper, section 3.3)."""

import dataclasses
from typing import Annotated, Literal, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from pydantic import Field, model_validator
from torch import Tensor, nn

from ghgs_lit.config.options import Count, Options, Width
from ghgs_lit.errors import require
from ghgs_lit.geometry.frame import places_around
from ghgs_lit.geometry.precision import exact
from ghgs_lit.geometry.projection import at_least_float32
from ghgs_lit.method.plan import Plan
from ghgs_lit.ops.linear import Linear
from ghgs_lit.ops.neighbors import attend_to_neighbors, nearest_neighbors, neighbor_cosines
from ghgs_lit.ops.pool import in_parts
from ghgs_lit.types import DecodedPixels, Points, Tokens

#: Effect of the similarity of two tokens on their logit; see :class:`SemanticAttention`.
Similarity = Literal["product", "product_clamped", "log", "none"]

#: Lower limit of the similarity with ``log``, since the logarithm is infinite at 0.
S_MIN = 0.01

#: Largest number of tokens computed at once on a CPU without a gradient.
_ROWS = 424


class RecalibrationOptions(Options):
    """Recalibration of tokens by multi-view semantic consistency (paper, Eqs. 3 to 5)."""

    group = "recalibration"
    k: Count | Annotated[float, Field(gt=0, lt=1)] = 64
    """Neighbours of each token: a number (64 in the authors' release; all tokens if there are fewer), or
    a fraction of the recalibrated tokens, such as 0.1, which is independent of the image size."""
    num_heads: Width = 8
    """Attention heads, which must divide a quarter of the token width; 8 in the release."""
    similarity: Similarity = "product"
    """Effect of the cosine s of semantic features on a logit: product: multiply by s (Eq. 3) |
    product_clamped: multiply by max(s, 0) (the release) | log: add log(max(s, 0.01)) | none: s = 1
    (ablation)"""
    neighborhood: Literal["xyz", "image_plane"] = "xyz"
    """Space in which distances are measured: xyz: between 3D points of tokens | image_plane: between
    centres of patches in pixels, as if all views were one (ablation: no unprojection)"""
    tokens: Literal["subject", "all"] = "subject"
    """Recalibrated tokens: subject: those with a point on the subject | all (the release)"""
    positions: Literal["none", "relative"] = "none"
    """Positional information in the attention values: none (the paper) | relative: offset of each
    neighbour from the token, in units of the subject (not in the paper; with neighborhood=xyz)"""

    @model_validator(mode="after")
    def _places_are_3d(self) -> "RecalibrationOptions":
        fits = self.positions == "none" or self.neighborhood == "xyz"
        self.require(fits, "positions", "none with neighborhood=image_plane, where tokens have no 3D points")
        return self

    def build(self, dim_latent: int) -> "Recalibration":
        """Build the stage with new weights for tokens of width ``dim_latent``.

        Raises:
            InputError: as :class:`SemanticAttention`.
        """
        return Recalibration(self, dim_latent)


class Neighborhood(NamedTuple):
    """Neighbours that n tokens attend to.

    Attributes:
        near: neighbours of each token, as indices into the n tokens.
        cosines: cosines of the semantic features of token and neighbour; None: s = 1.
        left_out: added to the logits: -inf for an invalid neighbour, else 0; None: all are valid.
        places: positions of the tokens in units of the subject; None: values do not depend on them.
    """

    near: Int[Tensor, "n k"]
    cosines: Float[Tensor, "n k"] | None = None
    left_out: Float[Tensor, "n k"] | None = None
    places: Float[Tensor, "n 3"] | None = None


class SemanticAttention(nn.Module):
    """``x + o(softmax(q . k / sqrt(d) * s) v)``, then a residual MLP; parameters are named as published.

    Args:
        dim: width C of the tokens; queries, keys and values have C / 4 channels.
        num_heads: number of heads, each with C / 4 / num_heads channels.
        similarity: effect of the cosine s of two tokens' semantic features on the logit:
            ``product`` multiplies by s (Eq. 3), ``product_clamped`` by max(s, 0) (the authors'
            release), ``log`` adds log(max(s, S_MIN)), which lowers the weight of dissimilar
            neighbours instead of moving their logit towards 0, ``none`` ignores it (s = 1).
        has_places: whether the value of a neighbour also depends on its position relative to the query,
            by a linear map of the difference that is initialised to 0 (not in the paper). By
            linearity that equals the map of a head's mean position minus the query's, which needs
            no tensor of all pairs.

    Raises:
        InputError: ``num_heads`` does not divide C / 4."""

    def __init__(
        self, dim: int, num_heads: int = 8, similarity: Similarity = "product", has_places: bool = False
    ):
        super().__init__()
        expected = f"heads that divide a quarter of the token width ({dim} / 4)"
        require(dim % (4 * num_heads) == 0, "recalibration.num_heads", expected, num_heads)
        self.num_heads = num_heads
        self.similarity = similarity
        inner = dim // 4
        self.norm1 = nn.LayerNorm(dim)
        self.q_proj = Linear(dim, inner)
        self.k_proj = Linear(dim, inner)
        self.v_proj = Linear(dim, inner)
        self.o_proj = Linear(inner, dim)
        self.norm2 = nn.LayerNorm(dim)
        self.mlp = nn.Sequential(Linear(dim, dim), nn.GELU(), Linear(dim, dim))
        self.place_proj = None
        if has_places:
            self.place_proj = nn.Linear(3, inner, bias=False)
            nn.init.zeros_(self.place_proj.weight)

    def forward(self, x: Float[Tensor, "n C"], neighborhood: Neighborhood) -> Float[Tensor, "n C"]:
        """Recalibrate tokens (Eqs. 3 and 5): keys and values of all first, then the tokens in parts.

        Args:
            x: tokens of one or several elements.
            neighborhood: neighbourhood of these tokens.
        """
        near, cosines, left_out, places = neighborhood
        factor, bias = self.factor_and_bias(cosines)
        if left_out is not None:
            bias = left_out if bias is None else bias + left_out
        is_whole = torch.is_grad_enabled() or x.device.type != "cpu"
        most = max(len(x), 1) if is_whole else _ROWS

        def keys_values(rows: slice) -> Float[Tensor, "m kv"]:
            normed = self.norm1(x[rows])
            return at_least_float32(torch.cat((self.k_proj(normed), self.v_proj(normed)), dim=-1))

        k, v = in_parts(keys_values, len(x), most).chunk(2, dim=-1)
        if places is not None:
            places = places.to(v.dtype)
            v = self._append_places(v, places)

        def recalibrate(rows: slice) -> Float[Tensor, "m C"]:
            q = at_least_float32(self.q_proj(self.norm1(x[rows])))
            changes = (None if values is None else values[rows] for values in (factor, bias))
            y = attend_to_neighbors(q, k, v, near[rows], self.num_heads, *changes)
            if places is not None:
                y = self._add_positions(y, places[rows])
            residual = x[rows] + self.o_proj(y)
            return residual + self.mlp(self.norm2(residual))

        return in_parts(recalibrate, len(x), most)

    def factor_and_bias(self, cosines: Float[Tensor, "*n"] | None) -> tuple[Tensor | None, Tensor | None]:
        """Factor and summand of the logits due to semantic similarity; None: no change.

        Args:
            cosines: cosines of tokens and neighbours, in [-1, 1]; None: s = 1.
        """
        if cosines is None:
            return None, None
        if self.similarity == "log":
            return None, cosines.clamp(min=S_MIN).log()
        return cosines.clamp(min=0) if self.similarity == "product_clamped" else cosines, None

    def _append_places(self, v: Float[Tensor, "n i"], places: Float[Tensor, "n 3"]) -> Float[Tensor, "n j"]:
        """Append the token's position to the channels of each head's values, j = i + 3 a."""
        heads = v.unflatten(1, (self.num_heads, -1))
        return torch.cat((heads, places[:, None].expand(-1, self.num_heads, -1)), dim=-1).flatten(1)

    def _add_positions(self, y: Float[Tensor, "m j"], places: Float[Tensor, "m 3"]) -> Float[Tensor, "m i"]:
        """Replace the mean positions in weighted values by their contribution, relative to the queries'."""
        values, mean = y.unflatten(1, (self.num_heads, -1)).tensor_split([-3], dim=-1)
        weight = self.place_proj.weight.to(y.dtype).unflatten(0, (self.num_heads, -1))
        with exact(y.device.type):
            return (values + torch.einsum("max,aix->mai", mean - places[:, None], weight)).flatten(1)


class Recalibration(nn.Module):
    """One :class:`SemanticAttention` for all layers; neighbours and cosines are computed once per forward."""

    def __init__(self, options: RecalibrationOptions, dim_latent: int):
        super().__init__()
        self.k = options.k
        self.neighborhood = options.neighborhood
        self.tokens = options.tokens
        self.has_places = options.positions == "relative"
        self.block = SemanticAttention(dim_latent, options.num_heads, options.similarity, self.has_places)

    def forward(self, tokens: Tokens, points: Points, plan: Plan) -> Tokens:
        """Recalibrate the layers of tokens; shapes, dtypes, semantic features and order are unchanged.

        Args:
            tokens: tokens of the encoder.
            points: points of these tokens in the subject's frame.
            plan: tokens in ``peers`` are recalibrated if their points are valid, or always with
                ``tokens="all"``.
        """
        rows = plan.peers.only(self.takes_part(points))
        neighborhoods = [self.neighborhood_of(tokens, points, *table) for table in rows.tables]
        counts = [len(each.near) for each in neighborhoods]
        layers = []
        for layer in tokens.latent:
            parts = zip(rows.take(layer).split(counts), neighborhoods, strict=True)
            new = [self.block(*part) for part in parts]
            layers.append((torch.cat(new) if len(new) > 1 else new[0]).to(layer.dtype))
        return dataclasses.replace(tokens, latent=rows.put(tokens.latent, layers))

    @torch.no_grad()
    def neighborhood_of(
        self,
        tokens: Tokens,
        points: Points,
        index: Int[Tensor, "*g n"],
        real: Bool[Tensor, "*g n"] | None = None,
    ) -> Neighborhood:
        """Find the neighbours that tokens of one or several elements attend to (Eq. 4).

        Args:
            tokens: tokens of the encoder.
            points: points of these tokens.
            index: indices of the tokens to recalibrate, by element.
            real: which of these are valid; the others are never attended to. None: all.
        """
        n = index.shape[-1]
        places = None
        if self.has_places:
            is_subject = points.tokens_valid[index] if real is None else points.tokens_valid[index] & real
            places = places_around(points.tokens[index], is_subject).flatten(0, -2)
        where = self.positions(tokens, points)[index]
        if real is not None:
            where = where.masked_fill(~real[..., None], torch.inf)
        number = self.places(tokens)
        number = None if number is None else number[index]
        near = nearest_neighbors(
            where, tokens.image[index], neighbor_count(self.k, n), number, tokens.grid[1]
        )
        cosines = None
        if self.block.similarity != "none":
            cosines = neighbor_cosines(tokens.semantic[index], near).flatten(0, -2)
        left_out = None
        if real is not None:
            # Elements with fewer tokens have fewer neighbours.
            most = near.shape[-1]
            wanted = real.sum(1, keepdim=True)
            wanted = (wanted.double() * self.k).round().clamp(min=1) if self.k < 1 else wanted.clamp(1, most)
            beyond = torch.arange(most, device=near.device) >= wanted[..., None]
            left_out = torch.where(beyond, -torch.inf, 0.0).expand(*real.shape, most).flatten(0, -2)
            if len(index) > 1:
                near = near + n * torch.arange(len(index), device=near.device)[:, None, None]
        return Neighborhood(near.flatten(0, -2), cosines, left_out, places)

    def takes_part(self, points: Points) -> Bool[Tensor, " N"]:
        """Mask of the tokens that are recalibrated and can be neighbours."""
        valid = points.tokens_valid
        return valid if self.tokens == "subject" else torch.ones_like(valid)

    def positions(self, tokens: Tokens, points: Points) -> Float[Tensor, "N d"]:
        """Position of each token in the space in which neighbours are searched, without a gradient:
        [N, 3] in the frame, or [N, 2] in pixels (row, column)."""
        if self.neighborhood == "xyz":
            return points.tokens.detach()
        # Half pixels are exact in float32, so equal distances compare equal.
        return (torch.stack((tokens.row, tokens.column), dim=-1) + 0.5) * tokens.patch_size

    def places(self, tokens: Tokens) -> Int[Tensor, " N"] | None:
        """``places`` for :func:`nearest_neighbors`; None for 3D points, which have no systematic ties."""
        if self.neighborhood != "image_plane":
            return None
        # Twice the columns, so that positions at equal distances from a query get different numbers.
        return tokens.row * 2 * tokens.grid[3] + tokens.column


def neighbor_count(k: int | float, tokens: int) -> int:
    """Number of neighbours of each token, at least 1.

    Args:
        k: number of neighbours, returned even if it exceeds ``tokens``; or, below 1, a fraction.
        tokens: number of recalibrated tokens of the element.
    """
    return max(round(k * tokens), 1) if k < 1 else int(k)


class NoRecalibrationOptions(Options):
    """No recalibration, for methods without attention across views after the encoder."""

    group = "recalibration"

    def build(self, dim_latent: int) -> "NoRecalibration":
        return NoRecalibration()


class NoRecalibration(nn.Module):
    """Returns the tokens unchanged."""

    tokens: DecodedPixels = "subject"

    def forward(self, tokens: Tokens, points: Points, plan: Plan) -> Tokens:
        return tokens
