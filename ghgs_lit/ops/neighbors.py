"""Exact nearest neighbours of tokens, and attention to them (paper, section 3.3), a part of the tokens
at a time where that saves memory."""

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from ghgs_lit.geometry.precision import exact
from ghgs_lit.geometry.projection import at_least_float32
from ghgs_lit.geometry.rotations import unit
from ghgs_lit.ops.linear import linear
from ghgs_lit.ops.pool import at_once, even_parts, in_parts

#: Distances in memory at once: a block fits a CPU's cache; on a GPU they take 200 MB with their keys.
_BLOCK = 1 << 17
_GPU_BLOCK = 1 << 23
#: Cosines in memory at once.
_COSINES = 1 << 21
_GPU_COSINES = 1 << 25
#: Largest number of scores of all tokens on a CPU.
_SCORES = 1 << 26
#: Largest number of gathered values of neighbours.
_GATHERED = 1 << 25


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

    def search(rows: slice) -> Int[Tensor, "*b m k"]:
        distance = torch.cdist(points[..., rows, :], points, compute_mode="donot_use_mm_for_euclid_dist")
        if places is None:
            ranks = torch.arange(n, device=points.device)
        else:
            apart = places[..., None, :] - places[..., rows, None]
            turn = (view[..., None, :] - view[..., rows, None]) % views
            ranks = (2 * apart.abs() + (apart < 0)) * views + turn
        return _smallest(distance, ranks, min(k, n))

    most = at_once(points.device, _BLOCK, _GPU_BLOCK) // max(points[..., 0].numel(), 1)
    return in_parts(search, n, most)


def _smallest(distance: Tensor, ranks: Int[Tensor, "*#bm n"], k: int) -> Int[Tensor, "*b m k"]:
    """Columns of the smallest values of each row, in the order of ``ranks`` where they are equal; NaN is
    largest."""
    if distance.dtype == torch.float64:
        order = ranks.argsort(dim=-1).expand(distance.shape)
        return order.gather(-1, distance.gather(-1, order).sort(dim=-1, stable=True).indices[..., :k])
    # `topk` does not define the order of equal values, so the rank is the lower half of the key. The
    # upper half is the bits of the distance, since those of non-negative floats sort like their values.
    # The sign of inf - inf is negative on some machines; abs() clears it.
    key = (distance.abs().view(torch.int32).long() << 32) | ranks
    return key.topk(k, dim=-1, largest=False).indices


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
    directions = unit(semantic)
    most = at_once(semantic.device, _COSINES, _GPU_COSINES) // max(1, len(directions.flatten(0, -2)))

    def compare(rows: slice) -> Float[Tensor, "*b m k"]:
        queries = directions[..., rows, :]
        products = linear(queries, directions) if queries.dim() == 2 else queries @ directions.mT
        return products.gather(-1, near[..., rows, :])

    with exact(semantic.device.type):
        return in_parts(compare, directions.shape[-2], most)


def attend_to_neighbors(
    q: Float[Tensor, "m i"],
    k: Float[Tensor, "n i"],
    v: Float[Tensor, "n j"],
    near: Int[Tensor, "m k"],
    heads: int,
    factor: Float[Tensor, "m k"] | None = None,
    bias: Float[Tensor, "m k"] | None = None,
) -> Float[Tensor, "m j"]:
    """Weighted values of the neighbours of ``m`` tokens, in float32 or wider.

    Args:
        q: queries of these tokens [m, i].
        k: keys of all n tokens [n, i].
        v: their values [n, j].
        near: neighbours of the m tokens [m, k].
        heads: number of heads, which divides i and j.
        factor: what logits are multiplied by [m, k]; None: 1.
        bias: what is added to them then [m, k]; None: 0.

    Returns:
        Values [m, j], heads concatenated.
    """
    with exact(q.device.type):
        if q.device.type != "cpu" or heads * len(q) * len(k) > _SCORES:
            return _attend_by_gathering(q, k, v, near, heads, factor, bias)
        # A product with all tokens is faster than gathering, and no tensor has the size m x k x C.
        q, k, v = (values.unflatten(1, (heads, -1)).transpose(0, 1) for values in (q, k, v))
        index = near[None].expand(heads, -1, -1)
        scores = q * q.shape[-1] ** -0.5 @ k.mT
        logits = _changed(scores.gather(2, index), factor, bias)
        # Without a gradient the weights reuse the memory of the scores.
        weights = torch.zeros_like(scores) if torch.is_grad_enabled() else scores.zero_()
        weights = weights.scatter_(2, index, logits.softmax(-1))
        return (weights @ v).transpose(0, 1).flatten(1)


def _attend_by_gathering(
    q: Tensor, k: Tensor, v: Tensor, near: Tensor, heads: int, factor: Tensor | None, bias: Tensor | None
) -> Tensor:
    """:func:`attend_to_neighbors` without a tensor as large as the square of the tokens. If there are
    several parts, the backward pass computes each again."""

    def attend(rows: slice) -> Tensor:
        of_rows = (None if values is None else values[rows] for values in (factor, bias))
        weights = neighbor_weights(q[rows], k[near[rows]], heads, *of_rows)
        return (weights[..., None] * v[near[rows]].unflatten(-1, (heads, -1))).sum(1).flatten(1)

    most = _GATHERED // max(1, near.shape[1] * q.shape[1])
    if len(q) <= most or not torch.is_grad_enabled():
        return in_parts(attend, len(q), most)
    options = {"use_reentrant": False, "preserve_rng_state": False}
    return torch.cat([checkpoint(attend, rows, **options) for rows in even_parts(len(q), most)])


def neighbor_weights(
    q: Float[Tensor, "m i"],
    keys: Float[Tensor, "m k i"],
    heads: int,
    factor: Float[Tensor, "m k"] | None = None,
    bias: Float[Tensor, "m k"] | None = None,
) -> Float[Tensor, "m k a"]:
    """Softmax weights, in each head, of the neighbours of ``m`` tokens.

    Args:
        q: queries of the tokens [m, i].
        keys: of their neighbours [m, k, i].
        heads: number of heads.
        factor: as of :func:`attend_to_neighbors`, as is the next.
        bias: what is added to the logits.

    Returns:
        Weights [m, k, a].
    """
    products = (q[:, None] * keys).unflatten(-1, (heads, -1)).sum(-1)
    factor, bias = (None if values is None else values[..., None] for values in (factor, bias))
    return _changed(products * (q.shape[1] // heads) ** -0.5, factor, bias).softmax(1)


def _changed(logits: Tensor, factor: Tensor | None, bias: Tensor | None) -> Tensor:
    logits = logits if factor is None else logits * factor
    return logits if bias is None else logits + bias
