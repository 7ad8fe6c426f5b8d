"""Attention weights and neighbours for inspection; training does not use them."""

import copy
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from ghgs_lit.method.recalibration.neighbors import nearest_neighbors
from ghgs_lit.method.recalibration.recalibration import Recalibration, neighbor_cosines, neighbor_count
from ghgs_lit.types import Points, Tokens


@dataclass(frozen=True)
class TokenAttention:
    """A token, its neighbours (nearest first), and their weights in every layer and head;
    ``plain``: the weights for s = 1. ``query`` and ``neighbors`` are indices of packed tokens."""

    query: int
    neighbors: Int[Tensor, " k"]
    weights: Float[Tensor, "L a k"]
    plain: Float[Tensor, "L a k"]


@torch.no_grad()
def attention_of(
    recalibration: Recalibration, tokens: Tokens, points: Points, query: int
) -> TokenAttention | None:
    """Attention of one token (Eqs. 3 to 5).

    Args:
        recalibration: the stage.
        tokens: inputs of the stage, as is the next.
        points: of these tokens.
        query: index of the packed token.

    Returns:
        Its neighbours and weights; None if it takes no part.
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


@torch.no_grad()
def attention_on_other_parts(
    recalibration: Recalibration, tokens: Tokens, points: Points, part: Int[Tensor, " N"]
) -> Float[Tensor, "m L"]:
    """Share of each token's attention, in each layer, on tokens that show another body part;
    mean over heads.

    Args:
        recalibration: the stage.
        tokens: inputs of the stage, as is the next.
        points: of these tokens.
        part: number of the part that a token shows [N]; -1: unknown: such tokens are no queries,
            and attention to them does not count.

    Returns:
        Shares [m, L] of the m tokens that take part and whose part is known.
    """
    takes_part = recalibration.takes_part(points)
    element = tokens.image // tokens.grid[1]
    shares = []
    for number in range(tokens.grid[0]):
        chosen = (takes_part & (element == number)).nonzero()[:, 0]
        near, weights = _weights(recalibration, tokens, points, chosen, slice(None))
        query_part = part[chosen, None]
        others = part[chosen][near]
        differs = (query_part != others) & (others >= 0)
        shares.append((weights.mean(-1) * differs).sum(-1).T[query_part[:, 0] >= 0])
    return torch.cat(shares)


def _near(
    recalibration: Recalibration, tokens: Tokens, points: Points, chosen: Int[Tensor, " n"]
) -> Int[Tensor, "n k"]:
    """Neighbours of some tokens of an element.

    Args:
        recalibration: the stage.
        tokens: inputs of the stage, as is the next.
        points: of these tokens.
        chosen: indices of the n packed tokens.

    Returns:
        Indices among the chosen ones [n, k].
    """
    places = recalibration.places(tokens)
    positions = recalibration.positions(tokens, points)
    places = None if places is None else places[chosen]
    k = neighbor_count(recalibration.k, len(chosen))
    return nearest_neighbors(positions[chosen], tokens.image[chosen], k, places, tokens.grid[1])


@dataclass(frozen=True)
class Neighborhood:
    """Whom the tokens of an element attend to. ``tokens``: that take part. ``neighbors``: of each,
    itself included. ``shared``: share of the neighbours that stay the same in the other setting of
    ``recalibration.neighborhood``; with nearly all tokens as neighbours that is nearly 1, and the
    ablation of 3D unprojection hardly changes anything."""

    tokens: int
    neighbors: int
    shared: float


@torch.no_grad()
def neighborhoods(recalibration: Recalibration, tokens: Tokens, points: Points) -> list[Neighborhood]:
    """The neighbourhood of each element.

    Args:
        recalibration: the stage.
        tokens: inputs of the stage, as is the next.
        points: of these tokens.

    Returns:
        One for each element of the batch.
    """
    other = copy.copy(recalibration)
    other.neighborhood = "image_plane" if recalibration.neighborhood == "xyz" else "xyz"
    takes_part = recalibration.takes_part(points)
    element = tokens.image // tokens.grid[1]
    results = []
    for number in range(tokens.grid[0]):
        chosen = (takes_part & (element == number)).nonzero()[:, 0]
        near, changed = (_near(stage, tokens, points, chosen) for stage in (recalibration, other))
        is_near = near.new_zeros(len(chosen), len(chosen), dtype=torch.bool).scatter_(1, near, True)
        shared = is_near.gather(1, changed).float().mean().item() if len(chosen) else 1.0
        results.append(Neighborhood(len(chosen), near.shape[1], shared))
    return results


#: A stage with its inputs, as :func:`neighborhoods` takes them.
Call = tuple[Recalibration, Tokens, Points]


@contextmanager
def seen_calls(recalibration: nn.Module | None) -> Iterator[list[Call]]:
    """Calls of the stage while the context lasts.

    Nothing is computed, so that what is timed takes no longer.

    Args:
        recalibration: the stage; None, or one without neighbours: the list stays empty.

    Yields:
        A list that gets the inputs of each call.
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
    """Neighbours and attention weights of some tokens of an element.

    Args:
        recalibration: the stage.
        tokens: inputs of the stage, as is the next.
        points: of these tokens.
        chosen: indices of the n packed tokens that take part.
        rows: which m of these are queries.
        plain: weights for s = 1.

    Returns:
        Neighbours of all chosen ones, as indices among them [n, k], and weights [L, m, k, a].
    """
    near = _near(recalibration, tokens, points, chosen)
    block = recalibration.block
    plain |= block.similarity == "none"
    cosines = None if plain else neighbor_cosines(tokens.semantic[chosen], near)
    each = [block.attention_weights(layer[chosen], rows, near, cosines) for layer in tokens.latent]
    return near, torch.stack(each)
