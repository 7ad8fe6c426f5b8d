"""Binary segmentation with minimal energy, by a minimum cut (Boykov and Jolly, ICCV 2001)."""

import numpy as np
from jaxtyping import Bool, Float
from scipy.sparse import csr_array
from scipy.sparse.csgraph import breadth_first_order, maximum_flow

#: Steps to four of a pixel's eight neighbours; the others are covered from those neighbours
NEIGHBOURS = ((0, 1), (1, 0), (1, 1), (1, -1))
_UNITS = 32  #: Integer capacity units per unit of energy
_MOST = 1 << 20  #: Largest capacity in units, so that no sum overflows


def neighbour_pairs(values: np.ndarray, step: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Values at both pixels of each pair of neighbours.

    Args:
        values: [h, w, ...].
        step: (rows, columns) from the first to the second pixel, of :data:`NEIGHBOURS`.

    Returns:
        Views of the values at the first and at the second pixels.
    """
    height, width = values.shape[:2]
    rows, columns = step
    first = values[: height - rows, max(-columns, 0) : width - max(columns, 0)]
    second = values[rows:, max(columns, 0) : width - max(-columns, 0)]
    return first, second


def minimum_cut(
    evidence: Float[np.ndarray, "h w"], costs: list[Float[np.ndarray, "..."]]
) -> Bool[np.ndarray, "h w"]:
    """Select the pixels that maximise the sum of evidence minus the costs of cut pairs.

    A pixel whose evidence exceeds the total cost of its pairs is decided by its evidence and is not a node
    of the graph.

    Args:
        evidence: evidence of each pixel, positive for the subject; dimensionless.
        costs: costs of different labels of neighbours, 0 or more, for each step of :data:`NEIGHBOURS`.

    Returns:
        True for selected pixels.
    """
    index = np.arange(evidence.size).reshape(evidence.shape)
    ends = [neighbour_pairs(index, step) for step in NEIGHBOURS]
    first = np.concatenate([a.ravel() for a, _ in ends])
    second = np.concatenate([b.ravel() for _, b in ends])
    cost = np.concatenate([each.ravel() for each in costs])
    evidence = evidence.ravel().astype(np.float64)
    around = np.bincount(first, cost, evidence.size) + np.bincount(second, cost, evidence.size)
    chosen = evidence > 0
    is_open = np.abs(evidence) < around
    # The cost of a pair with a decided neighbour becomes evidence.
    for one, other in ((first, second), (second, first)):
        beside = is_open[one] & ~is_open[other]
        signed = np.where(chosen[other[beside]], cost[beside], -cost[beside])
        evidence += np.bincount(one[beside], signed, evidence.size)
    both = is_open[first] & is_open[second]
    count = int(is_open.sum())
    number = np.cumsum(is_open) - 1
    chosen[is_open] = _cut(evidence[is_open], number[first[both]], number[second[both]], cost[both], count)
    return chosen.reshape(index.shape)


def _cut(
    evidence: np.ndarray, first: np.ndarray, second: np.ndarray, cost: np.ndarray, count: int
) -> np.ndarray:
    """Nodes [count] on the source's side of the minimum cut; ``first`` and ``second`` are the ends of each
    edge."""
    source, sink = count, count + 1
    nodes = np.arange(count)
    starts = np.concatenate((first, second, np.full(count, source), nodes))
    stops = np.concatenate((second, first, nodes, np.full(count, sink)))
    capacity = np.concatenate((cost, cost, evidence.clip(min=0), (-evidence).clip(min=0)))
    capacity = np.round(_UNITS * capacity).clip(max=_MOST).astype(np.int32)
    shape = count + 2, count + 2
    graph = csr_array((capacity, (starts, stops)), shape=shape)
    left = graph - maximum_flow(graph, source, sink).flow
    left.data = left.data.clip(min=0)
    left.eliminate_zeros()
    reached = np.zeros(count + 2, bool)
    reached[breadth_first_order(left, source, return_predecessors=False)] = True
    return reached[:count]
