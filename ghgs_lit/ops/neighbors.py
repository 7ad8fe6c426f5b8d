"""Exact nearest neighbours of tokens, and attention to them (paper, section 3.3).

Large inputs are processed in parts, to save memory."""

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from ghgs_lit.geometry.precision import exact
from ghgs_lit.geometry.projection import at_least_float32
from ghgs_lit.geometry.rotations import unit
from ghgs_lit.ops.linear import linear
from ghgs_lit.ops.pool import at_once, even_parts, in_parts

#: Distances in memory at once: a block fits a CPU's cache; on a GPU, distances and keys take 200 MB.
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
    """Find the nearest points of each point in all views, the point itself included.

    Leading dimensions are elements with the same number of points. Distances are computed from
    differences in float32 or wider: products would lose digits far from the origin.

    Args:
        points: positions of the tokens, of any dimension d.
        view: view of each token; used only with ``places``.
        k: number of neighbours, at least 1.
        places: a number for the place of each token, which breaks ties of distance: the nearest number
            first, so that opposite places alternate, and at each place the query's own view, then the
            next views. None: ties are ordered by index.
        views: number of views of an element; used only with ``places``.

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
    """Columns of the k smallest values of each row; ``ranks`` orders equal values, and NaN is largest."""
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

    Leading dimensions are elements with the same number of tokens.

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
    """Multi-head attention of ``m`` tokens to their neighbours, in float32 or wider.

    Args:
        q: queries of the m tokens [m, i].
        k: keys of all n tokens [n, i].
        v: values of all n tokens [n, j].
        near: neighbours of the m tokens [m, k].
        heads: number of heads, which divides i and j.
        factor: multiplies the logits [m, k]; None: 1.
        bias: added to the logits after ``factor`` [m, k]; None: 0.

    Returns:
        Values [m, j], heads concatenated.
    """
    with exact(q.device.type):
        if q.device.type != "cpu" or heads * len(q) * len(k) > _SCORES:
            return _attend_by_gathering(q, k, v, near, heads, factor, bias)
        # A product with all tokens is faster than gathering and needs no tensor of size m x k x C.
        q, k, v = (values.unflatten(1, (heads, -1)).transpose(0, 1) for values in (q, k, v))
        index = near[None].expand(heads, -1, -1)
        scores = q * q.shape[-1] ** -0.5 @ k.mT
        logits = _modify_logits(scores.gather(2, index), factor, bias)
        # Without a gradient the weights reuse the memory of the scores.
        weights = torch.zeros_like(scores) if torch.is_grad_enabled() else scores.zero_()
        weights = weights.scatter_(2, index, logits.softmax(-1))
        return (weights @ v).transpose(0, 1).flatten(1)


def _attend_by_gathering(
    q: Tensor, k: Tensor, v: Tensor, near: Tensor, heads: int, factor: Tensor | None, bias: Tensor | None
) -> Tensor:
    """:func:`attend_to_neighbors` without an m x n tensor; the backward pass recomputes each of several
    parts."""

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
    """Attention weights of the neighbours of ``m`` tokens, for each of ``a`` heads.

    Args:
        q: queries of the tokens [m, i].
        keys: keys of their neighbours [m, k, i].
        heads: number of heads, a.
        factor: multiplies the logits [m, k]; None: 1.
        bias: added to the logits after ``factor`` [m, k]; None: 0.

    Returns:
        Weights [m, k, a], which sum to 1 over k.
    """
    products = (q[:, None] * keys).unflatten(-1, (heads, -1)).sum(-1)
    factor, bias = (None if values is None else values[..., None] for values in (factor, bias))
    return _modify_logits(products * (q.shape[1] // heads) ** -0.5, factor, bias).softmax(1)


def _modify_logits(logits: Tensor, factor: Tensor | None, bias: Tensor | None) -> Tensor:
    logits = logits if factor is None else logits * factor
    return logits if bias is None else logits + bias
