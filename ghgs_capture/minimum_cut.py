"""Binary labels of pixels with the least energy, by a minimum cut (Boykov and Jolly, ICCV 2001)."""

import numpy as np
from jaxtyping import Bool, Float
from scipy.sparse import csr_array
from scipy.sparse.csgraph import breadth_first_order, maximum_flow

#: Steps to a pixel's neighbours; the other four are those of the neighbours.
NEIGHBOURS = ((0, 1), (1, 0), (1, 1), (1, -1))
_UNITS = 32  #: Capacities are whole numbers: units of an energy of 1
_MOST = 1 << 20  #: Largest capacity in units, so that no sum overflows


def neighbour_pairs(values: np.ndarray, step: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Values at both ends of each pair of neighbours.

    Args:
        values: of pixels [h, w, ...].
        step: rows (0 or more) and columns from the first to the second, of :data:`NEIGHBOURS`.

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
    """Choose the pixels whose sum of evidence, less the costs of pairs that are cut, is greatest.

    A pixel whose evidence exceeds what all of its pairs cost is decided by it,
    and is no node of the graph.

    Args:
        evidence: for each pixel, above 0 for the subject; without unit.
        costs: of neighbours with different labels, 0 or more, for each step of :data:`NEIGHBOURS`.

    Returns:
        Which pixels are chosen.
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
    # What a decided neighbour costs is evidence.
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
    """The side of the source of a graph with two terminals.

    Args:
        evidence: of each of the nodes.
        first: a node of each edge.
        second: the other.
        cost: of each edge.
        count: of nodes.

    Returns:
        Which nodes are on that side [count].
    """
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
