"""Recalibration of latent embeddings by multi-view semantic consistency (paper, section 3.3)."""

import dataclasses
from typing import Annotated, Literal

import torch
from jaxtyping import Bool, Float, Int
from pydantic import Field, model_validator
from torch import Tensor, nn

from ghgs_lit.config.options import Count, Options, Width
from ghgs_lit.geometry.precision import exact
from ghgs_lit.geometry.projection import at_least_float32
from ghgs_lit.geometry.rotations import unit
from ghgs_lit.method.plan import Plan
from ghgs_lit.method.plan.rows import Rows
from ghgs_lit.method.recalibration.attention import SemanticAttention, Similarity
from ghgs_lit.method.recalibration.neighbors import nearest_neighbors
from ghgs_lit.ops.linear import linear
from ghgs_lit.ops.pool import at_once, even_parts
from ghgs_lit.types import DecodedPixels, Points, Tokens

#: Cosines in memory at once.
_COSINES = 1 << 21  # on a CPU
_GPU_COSINES = 1 << 25


class RecalibrationOptions(Options):
    """Tokens to tokens by multi-view semantic consistency (paper, Eqs. 3 to 5)."""

    group = "recalibration"
    k: Count | Annotated[float, Field(gt=0, lt=1)] = 64
    """Neighbours of each token: a number (64 in the authors' release; all tokens where there are
    fewer), or a share of the subject's tokens that take part, such as 0.1, which means the same at
    every size."""
    num_heads: Width = 8
    """Attention heads; they divide a quarter of the token width. 8 in the release."""
    similarity: Similarity = "product"
    """How the cosine s of semantic features acts on a logit: product (s times it: Eq. 3) |
    product_clamped (max(s, 0) times it: the release) | log (adds log(max(s, 0.01))) | none
    (ablation: s = 1)"""
    neighborhood: Literal["xyz", "image_plane"] = "xyz"
    """Where distances are measured: xyz, between 3D points of tokens | image_plane, between centres
    of tokens in pixels, as if all views were one (ablation: no unprojection)"""
    tokens: Literal["subject", "all"] = "subject"
    """Tokens that take part: subject, those with a point on the subject | all (the release)"""
    positions: Literal["none", "relative"] = "none"
    """What values of attention know of places: none (the paper) | relative: where each neighbour
    lies from the token, in units of the subject (not the paper's; with neighborhood=xyz)"""

    @model_validator(mode="after")
    def _places_are_3d(self) -> "RecalibrationOptions":
        fits = self.positions == "none" or self.neighborhood == "xyz"
        self.require(fits, "positions", "none with neighborhood=image_plane, where tokens have no 3D points")
        return self

    def build(self, dim_latent: int) -> "Recalibration":
        """The stage.

        Args:
            dim_latent: width of the tokens.

        Returns:
            The stage with new weights.

        Raises:
            InputError: as :class:`SemanticAttention`.
        """
        return Recalibration(self, dim_latent)


class Recalibration(nn.Module):
    """One :class:`SemanticAttention` for all layers;
    neighbours and cosines are computed once per forward."""

    def __init__(self, options: RecalibrationOptions, dim_latent: int):
        super().__init__()
        self.k = options.k
        self.neighborhood = options.neighborhood
        self.tokens = options.tokens
        self.has_places = options.positions == "relative"
        self.block = SemanticAttention(dim_latent, options.num_heads, options.similarity, self.has_places)

    def forward(self, tokens: Tokens, points: Points, plan: Plan) -> Tokens:
        """Tokens with recalibrated layers; semantic features and order are unchanged.

        Args:
            tokens: of the encoder.
            points: of these tokens in the subject's frame.
            plan: its ``peers`` take part if their points are valid, or if all tokens do.

        Returns:
            Tokens of the same shapes and precision.
        """
        rows = plan.peers.only(self.takes_part(points))
        if rows.real is not None:
            return self._filled(tokens, points, rows)
        batch_size = tokens.grid[0]
        counts = rows.counts
        chosen = rows.index

        def part(values: Tensor) -> Tensor:
            return values if len(chosen) == len(values) else values[chosen]

        places = self.places(tokens)
        places = [None] * batch_size if places is None else part(places).split(counts)
        pairs = (part(values).split(counts) for values in (self.positions(tokens, points), tokens.image))
        elements = zip(*pairs, places, strict=True)
        neighbors = [
            nearest_neighbors(where, view, neighbor_count(self.k, len(where)), number, tokens.grid[1])
            for where, view, number in elements
        ]
        cosines = None
        if self.block.similarity != "none":
            semantic = part(tokens.semantic).split(counts)
            cosines = [neighbor_cosines(*pair) for pair in zip(semantic, neighbors, strict=True)]
        around = None
        if self.has_places:
            pairs = zip(*(part(x).split(counts) for x in (points.tokens, points.tokens_valid)), strict=True)
            around = [places_around(*pair) for pair in pairs]
        layers = []
        for layer in tokens.latent:
            new = self.block(part(layer), neighbors, cosines, places=around).to(layer.dtype)
            layers.append(new if len(new) == len(layer) else layer.index_copy(0, chosen, new))
        return dataclasses.replace(tokens, latent=tuple(layers))

    def _filled(self, tokens: Tokens, points: Points, rows: Rows) -> Tokens:
        """:meth:`forward` for elements with the same number of rows, all at once.

        Rows that do not count are out of reach of the others, and their results are not read.

        Args:
            tokens: of the encoder.
            points: of these tokens.
            rows: of packed tokens, the same number in each element, and which of them count.

        Returns:
            Tokens of the same shapes and precision.
        """
        shape = (len(rows.counts), rows.counts[0])
        places = self.places(tokens)
        real = rows.real.view(shape)
        of_tokens = (self.positions(tokens, points), tokens.image)
        where, image = (values[rows.index].unflatten(0, shape) for values in of_tokens)
        around = None
        if self.has_places:
            around = [places_around(where, real & points.tokens_valid[rows.index].view(shape)).flatten(0, 1)]
        where = where.masked_fill(~real[..., None], torch.inf)
        places = None if places is None else places[rows.index].view(shape)
        most = min(neighbor_count(self.k, shape[1]), shape[1])
        near = nearest_neighbors(where, image, most, places, tokens.grid[1])
        cosines = None
        if self.block.similarity != "none":
            semantic = tokens.semantic[rows.index].unflatten(0, shape)
            cosines = [neighbor_cosines(semantic, near).flatten(0, 1)]
        # Elements with fewer tokens have fewer neighbours.
        wanted = real.sum(1, keepdim=True)
        wanted = (wanted.double() * self.k).round().clamp(min=1) if self.k < 1 else wanted.clamp(1, most)
        beyond = torch.arange(most, device=near.device) >= wanted[..., None]
        left_out = torch.where(beyond, -torch.inf, 0.0).expand(*shape, most).flatten(0, 1)
        if shape[0] > 1:
            near = near + shape[1] * torch.arange(shape[0], device=near.device)[:, None, None]
        takes_part, number = rows.places(len(tokens.image))
        layers = []
        for layer in tokens.latent:
            new = self.block(layer[rows.index], [near.flatten(0, 1)], cosines, left_out, around)
            new = new.to(layer.dtype)
            layers.append(torch.where(takes_part[:, None], new.index_select(0, number), layer))
        return dataclasses.replace(tokens, latent=tuple(layers))

    def takes_part(self, points: Points) -> Bool[Tensor, " N"]:
        """Tokens that are recalibrated and can be neighbours."""
        valid = points.tokens_valid
        return valid if self.tokens == "subject" else torch.ones_like(valid)

    def positions(self, tokens: Tokens, points: Points) -> Float[Tensor, "N d"]:
        """Position of each token in the space where neighbours are searched; see ``neighborhood``.

        Args:
            tokens: of the encoder.
            points: of these tokens.

        Returns:
            [N, 3] in the frame, or [N, 2] in pixels (row, column); without a gradient.
        """
        if self.neighborhood == "xyz":
            return points.tokens.detach()
        # Half pixels are exact in float32, so equal distances are equal numbers.
        return (torch.stack((tokens.row, tokens.column), dim=-1) + 0.5) * tokens.patch_size

    def places(self, tokens: Tokens) -> Int[Tensor, " N"] | None:
        """``places`` for :func:`nearest_neighbors`;
        None for 3D points, which have no systematic ties."""
        if self.neighborhood != "image_plane":
            return None
        # Twice the columns, so that places at equal distances from a query differ in their numbers.
        return tokens.row * 2 * tokens.grid[3] + tokens.column


def neighbor_count(k: int | float, tokens: int) -> int:
    """Neighbours of each of an element's tokens.

    Args:
        k: their number, or below 1 a share of the tokens.
        tokens: of the element, that take part.

    Returns:
        1 or more; a number ``k`` may exceed that of the tokens.
    """
    return max(round(k * tokens), 1) if k < 1 else int(k)


@torch.no_grad()
def places_around(
    points: Float[Tensor, "*b n 3"], is_subject: Bool[Tensor, "*b n"]
) -> Float[Tensor, "*b n 3"]:
    """Places of tokens around the middle of the subject, in units of its size.

    The middle is the mean of the subject's points, the unit their root mean square distance from
    it, so that places depend neither on the world's origin nor on its unit.

    Args:
        points: of the tokens of an element, or of several with the same number.
        is_subject: which points lie on the subject; middle and unit are of these.

    Returns:
        Places, float32 or wider; 0 for points that are not finite,
        or if all of the subject's coincide.
    """
    points = at_least_float32(points)
    is_finite = points.isfinite().all(-1)
    weights = (is_subject & is_finite).to(points.dtype)
    weights = (weights / weights.sum(-1, keepdim=True).clamp(min=1))[..., None]
    points = torch.where(is_finite[..., None], points, 0)
    middle = (weights * points).sum(-2, keepdim=True)
    around = torch.where(is_finite[..., None], points - middle, 0)
    unit_length = (weights * around.square()).sum((-2, -1), keepdim=True).sqrt()
    return around / torch.where(unit_length > 0, unit_length, torch.inf)


@torch.no_grad()
def neighbor_cosines(
    semantic: Float[Tensor, "*b n s"], near: Int[Tensor, "*b n k"]
) -> Float[Tensor, "*b n k"]:
    """Cosines of the semantic features of tokens and their neighbours (Eq. 4).

    One element, or several with the same number of tokens.

    Args:
        semantic: features [..., n, s].
        near: indices of neighbours [..., n, k].

    Returns:
        [..., n, k], float32 or wider; 0 for features of zeros.
    """
    with exact(semantic.device.type):
        semantic = at_least_float32(semantic)
        # Allocated before temporary tensors, so that their memory can be freed.
        cosines = semantic.new_empty(near.shape)
        directions = unit(semantic)
        most = at_once(semantic.device, _COSINES, _GPU_COSINES)
        count = directions.shape[-2]
        for rows in even_parts(count, most // max(1, len(directions.flatten(0, -2)))):
            queries = directions[..., rows, :]
            products = linear(queries, directions) if queries.dim() == 2 else queries @ directions.mT
            torch.gather(products, -1, near[..., rows, :], out=cosines[..., rows, :])
    return cosines


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
