"""Attention weights of one token, for pictures; training does not use them."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ghgs_lit.recalibration.neighbors import nearest_neighbors
from ghgs_lit.recalibration.recalibration import Recalibration, neighbor_cosines
from ghgs_lit.types import Points, Tokens


@dataclass(frozen=True)
class TokenAttention:
    """Token ``query``, its neighbours (nearest first), and the weight of each in every layer and head.

    ``query`` and ``neighbors`` are indices of packed tokens.
    """

    query: int
    neighbors: Int[Tensor, " k"]
    weights: Float[Tensor, "L a k"]


@torch.no_grad()
def attention_of(
    recalibration: Recalibration, tokens: Tokens, points: Points, query: int
) -> TokenAttention | None:
    """Attention weights of each layer and head from one token to its neighbours (Eqs. 3 to 5).

    Args:
        recalibration: the stage.
        tokens, points: as in the stage's forward.
        query: index of a packed token.

    Returns:
        None where that token takes no part in the recalibration.
    """
    takes_part = recalibration.takes_part(points)
    if not takes_part[query]:
        return None
    element = tokens.image // tokens.grid[1]
    chosen = (takes_part & (element == element[query])).nonzero()[:, 0]
    row = int((chosen == query).nonzero())
    positions = recalibration.positions(tokens, points)[chosen]
    places = recalibration.places(tokens)
    near = nearest_neighbors(
        positions,
        tokens.image[chosen],
        recalibration.k,
        None if places is None else places[chosen],
    )
    block, valid = recalibration.block, near.valid[row]
    cosines = neighbor_cosines(tokens.semantic[chosen], near) if block.similarity != "none" else None
    weights = [block.attention_weights(layer[chosen], row, near, cosines) for layer in tokens.latent]
    return TokenAttention(query, chosen[near.index[row][valid]], torch.stack(weights)[..., valid])
