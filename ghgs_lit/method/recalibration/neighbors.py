"""Exact nearest neighbours among the tokens of one batch element (paper, section 3.3)."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ghgs_lit.geometry.projection import at_least_float32
from ghgs_lit.ops.pool import at_once, even_parts

#: Distances in memory at once: a block fits a CPU's cache.
_BLOCK = 1 << 17
#: The same on a GPU, where they take 200 MB with their keys.
_GPU_BLOCK = 1 << 23


@torch.no_grad()
def nearest_neighbors(
    points: Float[Tensor, "*b n d"],
    view: Int[Tensor, "*b n"],
    k: int,
    places: Int[Tensor, "*b n"] | None = None,
    views: int = 0,
) -> Int[Tensor, "*b n k"]:
    """The nearest points of each point in any view, itself included.

    Of one element, or of several with the same number of points. Distances are computed from
    differences in float32 or wider: products would lose digits far from the origin.

    Args:
        points: positions of the tokens, of any dimension d.
        view: the view of each token; read with ``places``.
        k: number of neighbours, at least 1.
        places: a number of each token's place, which orders points at equal distances: nearest
            number first, so that opposite places alternate, and at each place the query's own view,
            then the next views. None: ties by index.
        views: number of views of an element; read with ``places``.

    Returns:
        Indices [..., n, min(k, n)], nearest first.
    """
    points = at_least_float32(points)
    n = points.shape[-2]
    k = min(k, n)
    # Filled, not concatenated: small results between freed blocks of distances would
    # fragment the memory.
    index = torch.empty(*points.shape[:-1], k, dtype=torch.int64, device=points.device)
    for rows in even_parts(n, at_once(points.device, _BLOCK, _GPU_BLOCK) // max(points[..., 0].numel(), 1)):
        queries = points[..., rows, :]
        distance = torch.cdist(queries, points, compute_mode="donot_use_mm_for_euclid_dist")
        ranks = None if places is None else _turns(places, view, views, rows)
        index[..., rows, :] = _smallest(distance, ranks, k)
    return index


def _turns(places: Tensor, view: Tensor, views: int, block: slice) -> Int[Tensor, "*b m n"]:
    """Ranks of tokens at equal distances from some queries;
    see ``places`` of :func:`nearest_neighbors`.

    Args:
        places: a number of each token's place [..., n].
        view: the view of each token [..., n].
        views: number of views of an element.
        block: which m tokens are the queries.

    Returns:
        Ranks [..., m, n], the least first.
    """
    apart = places[..., None, :] - places[..., block, None]
    turn = (view[..., None, :] - view[..., block, None]) % views
    return (2 * apart.abs() + (apart < 0)) * views + turn


def _smallest(
    distance: Float[Tensor, "*b m n"], ranks: Int[Tensor, "*b m n"] | None, k: int
) -> Int[Tensor, "*b m k"]:
    """Columns of the smallest values of each row; NaN is largest.

    ``topk`` does not define the order of equal values, so the rank is the lower half of the
    key; the upper half is the bits of the distance, since those of non-negative floats sort
    like their values.

    Args:
        distance: [..., m, n], 0 or more.
        ranks: order of columns at equal distances [..., m, n], below 2^32; None: by column.
        k: how many, up to n.

    Returns:
        Indices of columns [..., m, k], ascending by value.
    """
    if distance.dtype == torch.float64:
        if ranks is None:
            return distance.sort(dim=-1, stable=True).indices[..., :k]
        order = ranks.argsort(dim=-1)
        return order.gather(-1, distance.gather(-1, order).sort(dim=-1, stable=True).indices[..., :k])
    if ranks is None:
        ranks = torch.arange(distance.shape[-1], device=distance.device)
    # The sign of inf - inf is negative on some machines; abs() clears it.
    key = (distance.abs().view(torch.int32).long() << 32) | ranks
    return key.topk(k, dim=-1, largest=False).indices
