"""Inspection of attention weights and neighbours; not used by predictions."""

import copy
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from ghgs_lit.geometry.projection import at_least_float32
from ghgs_lit.method.recalibration.recalibration import Recalibration
from ghgs_lit.ops.neighbors import neighbor_weights
from ghgs_lit.types import Points, Tokens


@dataclass(frozen=True)
class TokenAttention:
    """A token, its neighbours (nearest first), and their weights in every layer and head.

    ``query`` and ``neighbors`` are indices of packed tokens; ``plain``: weights for s = 1."""

    query: int
    neighbors: Int[Tensor, " k"]
    weights: Float[Tensor, "L a k"]
    plain: Float[Tensor, "L a k"]


@torch.no_grad()
def attention_of(
    recalibration: Recalibration, tokens: Tokens, points: Points, query: int
) -> TokenAttention | None:
    """Neighbours and attention weights of one token (Eqs. 3 to 5); None if it is not recalibrated.

    Args:
        recalibration: the stage.
        tokens: input of the stage.
        points: points of these tokens.
        query: index of the packed token.
    """
    takes_part = recalibration.takes_part(points)
    if not takes_part[query]:
        return None
    element = tokens.image // tokens.grid[1]
    chosen = (takes_part & (element == element[query])).nonzero()[:, 0]
    row = int((chosen == query).nonzero())
    stage = (recalibration, tokens, points, chosen, slice(row, row + 1))
    near, weights = _weights(*stage)
    _, plain = _weights(*stage, plain=True)
    return TokenAttention(query, chosen[near[row]], weights[:, 0].mT, plain[:, 0].mT)


@dataclass(frozen=True)
class Overlap:
    """Neighbourhoods of an element's tokens.

    Attributes:
        tokens: number of recalibrated tokens.
        neighbors: number of neighbours of each, including itself.
        shared: fraction of the neighbours that are the same with the other value of
            ``recalibration.neighborhood``. With nearly all tokens as neighbours it is close to 1, and
            the ablation of 3D unprojection hardly changes anything.
    """

    tokens: int
    neighbors: int
    shared: float


@torch.no_grad()
def neighborhoods(recalibration: Recalibration, tokens: Tokens, points: Points) -> list[Overlap]:
    """Compare the neighbourhoods of each element with those of the other ``neighborhood`` setting.

    Args:
        recalibration: the stage.
        tokens: input of the stage.
        points: points of these tokens.
    """
    other = copy.copy(recalibration)
    other.neighborhood = "image_plane" if recalibration.neighborhood == "xyz" else "xyz"
    pair = (recalibration, other)
    takes_part = recalibration.takes_part(points)
    element = tokens.image // tokens.grid[1]
    results = []
    for number in range(tokens.grid[0]):
        chosen = (takes_part & (element == number)).nonzero()[:, 0]
        near, changed = (stage.neighborhood_of(tokens, points, chosen).near for stage in pair)
        is_near = near.new_zeros(len(chosen), len(chosen), dtype=torch.bool).scatter_(1, near, True)
        shared = is_near.gather(1, changed).float().mean().item() if len(chosen) else 1.0
        results.append(Overlap(len(chosen), near.shape[1], shared))
    return results


#: Arguments of :func:`neighborhoods`: a stage and its inputs.
Call = tuple[Recalibration, Tokens, Points]


@contextmanager
def collect_calls(recalibration: nn.Module | None) -> Iterator[list[Call]]:
    """Collect the inputs of the stage's calls within the context, appended to the yielded list.

    Nothing is computed, so measured run times are unaffected.

    Args:
        recalibration: the stage; for None, or one without neighbours, the list stays empty.
    """
    calls: list[Call] = []
    if not isinstance(recalibration, Recalibration):
        yield calls
        return
    hook = recalibration.register_forward_pre_hook(lambda stage, inputs: calls.append((stage, *inputs[:2])))
    try:
        yield calls
    finally:
        hook.remove()


def _weights(
    recalibration: Recalibration,
    tokens: Tokens,
    points: Points,
    chosen: Int[Tensor, " n"],
    rows: slice,
    plain: bool = False,
) -> tuple[Int[Tensor, "n k"], Float[Tensor, "L m k a"]]:
    """Neighbours [n, k] of the ``chosen`` tokens of an element, as indices into these, and attention
    weights [L, m, k, a] of the queries ``rows``; ``plain``: weights for s = 1."""
    near, cosines, *_ = recalibration.neighborhood_of(tokens, points, chosen)
    block = recalibration.block
    changes = [values if values is None else values[rows] for values in block.factor_and_bias(cosines)]
    each = []
    for layer in tokens.latent:
        normed = block.norm1(layer[chosen])
        q = at_least_float32(block.q_proj(normed[rows]))
        keys = at_least_float32(block.k_proj(normed))[near[rows]]
        each.append(neighbor_weights(q, keys, block.num_heads, *([None, None] if plain else changes)))
    return near, torch.stack(each)
