"""Exact nearest neighbours among the tokens of one batch element (paper, section 3.3)."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ghgs_lit.errors import choice, require
from ghgs_lit.geometry.projection import at_least_float32
from ghgs_lit.kernels.parts import even_parts

MODES = ("all", "other_views", "mixed")

#: Number of distances that are held at once: bounds memory, and keeps a block in a CPU's cache.
_BLOCK = 1 << 17


@dataclass(frozen=True)
class Neighbors:
    """Indices of the ``k`` neighbours of each of ``n`` tokens; only ``valid`` entries count."""

    index: Int[Tensor, "n k"]
    valid: Bool[Tensor, "n k"]


@torch.no_grad()
def nearest_neighbors(
    points: Float[Tensor, "n d"], view: Int[Tensor, " n"], k: int, mode: str = "all"
) -> Neighbors:
    """The ``min(k, n)`` nearest points of each point, nearest first, ties by index.

    Distances are computed from differences in float32 or wider (the expansion into products would lose
    digits far from the origin).

    Args:
        points: positions of the tokens, of any dimension d.
        view: the view of each token.
        k: number of neighbours.
        mode: ``all`` searches all views, the point itself included; ``other_views`` all views but the
            query's own (where there is no such point, the query itself); ``mixed`` takes up to ``k // 2``
            from the query's own view, itself included, and the rest from other views.
    """
    choice("recalibration.neighbors", mode, MODES)
    require(k >= 1, "recalibration.k", "1 or more", k)
    points = at_least_float32(points)
    n = points.shape[0]
    # Filled, not concatenated: small results between freed distances would keep that memory occupied.
    index = torch.empty(n, min(k, n), dtype=torch.int64, device=points.device)
    valid = torch.empty_like(index, dtype=torch.bool)
    for rows in even_parts(n, _BLOCK // max(n, 1)):
        part = _nearest_to_block(points, view, rows, min(k, n), mode)
        index[rows], valid[rows] = part.index, part.valid
    return Neighbors(index, valid)


def _nearest_to_block(points: Tensor, view: Tensor, block: slice, k: int, mode: str) -> Neighbors:
    distance = torch.cdist(points[block], points, compute_mode="donot_use_mm_for_euclid_dist")
    if mode == "all":
        index = _smallest(distance, k)
        return Neighbors(index, torch.ones_like(index, dtype=torch.bool))
    same = view[block, None] == view
    other = _allowed(distance, ~same, k if mode == "other_views" else k - k // 2)
    if mode == "mixed":
        own = _allowed(distance, same, k // 2)
        return Neighbors(
            torch.cat((own.index, other.index), dim=1), torch.cat((own.valid, other.valid), dim=1)
        )
    alone = ~other.valid.any(1)
    query = torch.arange(len(points), device=points.device)[block]
    index = torch.where(alone[:, None], query[:, None], other.index)
    first = torch.arange(index.shape[1], device=points.device) == 0
    return Neighbors(index, other.valid | (alone[:, None] & first))


def _allowed(distance: Tensor, mask: Tensor, k: int) -> Neighbors:
    """The nearest points inside ``mask``; the distances of all others become NaN, which sorts last."""
    index = _smallest(torch.where(mask, distance, float("nan")), k)
    return Neighbors(index, mask.gather(1, index))


def _smallest(distance: Float[Tensor, "m n"], k: int) -> Int[Tensor, "m k"]:
    """Columns of the ``k`` smallest values of each row, ascending, ties by column; NaN is largest.

    ``topk`` does not define the order of equal values, so the column is part of the key: the bits of a
    non-negative float32 sort like its value, and the column fills the lower half.
    """
    if distance.dtype == torch.float64:
        return distance.sort(dim=1, stable=True).indices[:, :k]
    column = torch.arange(distance.shape[1], device=distance.device)
    # The sign of inf - inf is negative on some machines; abs() clears it.
    key = (distance.abs().view(torch.int32).long() << 32) | column
    return key.topk(k, dim=1, largest=False).values & 0xFFFFFFFF
