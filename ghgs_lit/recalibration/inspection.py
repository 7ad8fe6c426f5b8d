"""What one token attends to: to look at, not to train with."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ghgs_lit.geometry.projection import at_least_float32
from ghgs_lit.recalibration.neighbors import nearest_neighbors
from ghgs_lit.recalibration.recalibration import Recalibration, neighbor_cosines
from ghgs_lit.types import Batch, Points, Tokens


@dataclass(frozen=True)
class TokenAttention:
    """The neighbours of token ``query``, nearest first, as indices of packed tokens; their weights."""

    query: int
    neighbors: Int[Tensor, " k"]
    weights: Float[Tensor, "L a k"]


@torch.no_grad()
def attention_of(
    recalibration: Recalibration, tokens: Tokens, points: Points, batch: Batch, query: int
) -> TokenAttention | None:
    """Attention weights of each layer and head from one token to its neighbours (Eqs. 3 to 5).

    The arguments are those of ``recalibration``'s forward; ``query`` is the index of a packed token. None
    where that token takes no part.
    """
    views = batch.masks.shape[1]
    takes_part = points.tokens_valid | (recalibration.tokens == "all")
    if not takes_part[query]:
        return None
    element = tokens.image // views
    chosen = (takes_part & (element == element[query])).nonzero()[:, 0]
    place = int((chosen == query).nonzero())
    positions = recalibration._positions(tokens, points)[chosen]
    near = nearest_neighbors(positions, tokens.image[chosen], recalibration.k, recalibration.neighbors)
    block, known = recalibration.block, near.valid[place]
    index = near.index[place]
    cosine = None
    if block.similarity != "none":
        cosine = neighbor_cosines(tokens.semantic[chosen], near)[place]
    weights = [_weights(block, layer[chosen], place, index, cosine, known) for layer in tokens.latent]
    return TokenAttention(query, chosen[index[known]], torch.stack(weights)[..., known])


def _weights(
    block, x: Tensor, place: int, index: Tensor, cosine: Tensor | None, known: Tensor
) -> Float[Tensor, "a k"]:
    """Softmax over the neighbours of the token at ``place`` of ``x``."""
    normed = block.norm1(x)
    q = block.q_proj(normed[place]).unflatten(-1, (block.num_heads, -1))
    k = block.k_proj(normed[index]).unflatten(-1, (block.num_heads, -1))
    logits = at_least_float32(torch.einsum("ad,kad->ak", q * q.shape[-1] ** -0.5, k))[:, None]
    if cosine is not None:
        logits = block._weigh(logits, cosine[None])
    return logits[:, 0].masked_fill(~known, float("-inf")).softmax(-1)
