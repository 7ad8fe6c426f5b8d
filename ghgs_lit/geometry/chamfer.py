"""Chamfer distance between two point sets (the paper's geometric loss L_geom).

Nearest neighbours are exact and carry no gradient; the gradient runs through the matched pairs only.
"""

import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from ghgs_lit.geometry.projection import at_least_float32


def nearest(
    queries: Float[Tensor, "n 3"], references: Float[Tensor, "m 3"], chunk: int = 2048
) -> Int[Tensor, " n"]:
    """Index of the nearest reference of each query.

    On the CPU by a k-d tree in float64; on an accelerator by explicit differences (the matrix-product form of
    the distance is off by a millimetre at two metres).

    Args:
        queries: a point that is not finite gets any reference; its distance is not finite either.
        references: finite coordinates, one point at least.
        chunk: queries that are compared at once on an accelerator.
    """
    queries, references = at_least_float32(queries.detach()), at_least_float32(references.detach())
    queries = queries.nan_to_num(0.0, 0.0, 0.0)
    if queries.device.type == "cpu":
        tree = cKDTree(references.double().numpy(), balanced_tree=False, compact_nodes=False)
        index = tree.query(queries.double().numpy(), workers=torch.get_num_threads())[1]
        return torch.from_numpy(index)
    exact = "donot_use_mm_for_euclid_dist"
    blocks = [torch.cdist(block, references, compute_mode=exact).argmin(-1) for block in queries.split(chunk)]
    return torch.cat(blocks) if blocks else queries.new_zeros(0, dtype=torch.long)


def subsample(points: Float[Tensor, "n 3"], limit: int | None) -> Float[Tensor, "m 3"]:
    """At most ``limit`` of the points (None: all), evenly spaced in memory from a random start."""
    if limit is None or len(points) <= limit:
        return points
    steps = torch.arange(limit, dtype=torch.float64) + torch.rand((), dtype=torch.float64)
    index = (steps * (len(points) / limit)).long().clamp(max=len(points) - 1)
    return points[index.to(points.device)]


def chamfer(
    points: Float[Tensor, "n 3"], references: Float[Tensor, "m 3"], limit: int | None = None
) -> Float[Tensor, ""]:
    """Mean squared distance from each point to its nearest reference, plus the mean the other way round.
    Returns: 0 where either set is empty (with a gradient of 0); nan where a coordinate is not finite.

    Args:
        points: the prediction, in metres.
        references: the surface, in metres.
        limit: points of each set that are matched at most (to all of the other set, so that the mean stays
            unbiased); None: all.
    """
    points, references = at_least_float32(points), at_least_float32(references)
    if not (torch.isfinite(points).all() and torch.isfinite(references).all()):
        return (points.sum() + references.sum()) * torch.nan
    if len(points) == 0 or len(references) == 0:
        return points.sum() * 0 + references.sum() * 0
    some, few = subsample(points, limit), subsample(references, limit)
    there = (some - references[nearest(some, references)]).square().sum(-1)
    back = (points[nearest(few, points)] - few).square().sum(-1)
    return there.mean() + back.mean()
