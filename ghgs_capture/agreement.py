"""Do the masks of one instant agree? Each is tested by leaving its view out.

A grid of points around the subject is looked up in every mask. A pixel can show the subject only
where its ray passes a point inside the other masks: the hull of the others (visual hull;
Laurentini, PAMI 1994).
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from ghgs_capture.capture import Capture
from ghgs_capture.crops import Photograph
from ghgs_lit.geometry.masks import signed_distance

_POINTS = 56  #: Points of the grid along each axis
_LARGER = 1.4  #: Side of the grid, in heights of the subject
_NOWHERE = -99.0  #: Depth in the others' masks where a ray passes no point
#: Share of a mask that its hull may lack, and that a mask may take from another's hull,
#: before it fails.
MISSED = 0.01


def reach_of(size: tuple[int, int]) -> int:
    """Pixels by which outlines of masks, and cameras, may be wrong.

    Args:
        size: (height, width) of a photograph in pixels.
    """
    return max(max(size) // 200, 2)


@dataclass(frozen=True)
class Agreement:
    """How deep points of a grid lie in the masks of an instant."""

    photographs: tuple[Photograph, ...]
    #: [V, n] pixels inside the mask of each view, below 0 outside; beyond a photograph that cuts
    #: its subject 0, which says nothing
    depths: Float[np.ndarray, "V n"]
    #: [V, n] cell of each point in each view, -1 beyond the photograph
    cells: Float[np.ndarray, "V n"]
    steps: tuple[int, ...]  #: side of a cell in pixels, by view

    @classmethod
    def of(cls, capture: Capture) -> "Agreement | None":
        """Look up a grid around the subject in all masks.

        Args:
            capture: of an instant.

        Returns:
            The depths; None where fewer than three views leave nothing to compare.
        """
        photographs = capture.photographs
        if len(photographs) < 3:
            return None
        middle = _middle(photographs)
        distances = [p.extrinsics[2, :3] @ middle + p.extrinsics[2, 3] for p in photographs]
        sides = []
        for photograph, distance in zip(photographs, distances, strict=True):
            longest = max(end - first for first, end in photograph.extents)
            sides.append(longest * distance / photograph.intrinsics[0, 0])
        side = _LARGER * float(np.median(sides))
        line = ((np.arange(_POINTS) + 0.5) / _POINTS - 0.5) * side
        grid = np.stack(np.meshgrid(line, line, line, indexing="ij"), -1).reshape(-1, 3)
        depths, cells, steps = [], [], []
        for photograph, distance in zip(photographs, distances, strict=True):
            steps.append(max(int(side / _POINTS * photograph.intrinsics[0, 0] / distance), 1))
            depth, cell = _looked_up(photograph, grid, middle, steps[-1])
            depths.append(depth)
            cells.append(cell)
        return cls(photographs, np.stack(depths), np.stack(cells), tuple(steps))

    def depth_in_others(self, view: int, without: tuple[int, ...] = (), spare: int = 0) -> np.ndarray:
        """By how many pixels the best point of each pixel's ray lies inside the other masks.

        Args:
            view: whose pixels; its mask is left out.
            without: further views that are left out.
            spare: how many of the others a point may miss.

        Returns:
            [h, w] float32; least depth over the others, ``_NOWHERE`` where there is no point.
        """
        others = [v for v in range(len(self.depths)) if v != view and v not in without]
        depths = np.sort(self.depths[others], 0)[spare] if spare else self.depths[others].min(0)
        height, width = self.photographs[view].mask.shape
        step = self.steps[view]
        rows, columns = -(-height // step), -(-width // step)
        seen = self.cells[view] >= 0
        best = np.full(rows * columns, _NOWHERE, np.float32)
        np.maximum.at(best, self.cells[view][seen], depths[seen])
        # A cell between the projections of two points has the depth of its neighbours.
        best = ndimage.maximum_filter(best.reshape(rows, columns), 3)
        return best.repeat(step, 0).repeat(step, 1)[:height, :width]

    def outside(self, view: int, without: tuple[int, ...] = ()) -> float:
        """Share of a mask that lies outside the hull of the others.

        Args:
            view: whose mask.
            without: views whose masks do not count.
        """
        photograph = self.photographs[view]
        away = self.depth_in_others(view, without) < -reach_of(photograph.mask.shape)
        return float((photograph.mask & away).sum() / photograph.mask.sum())

    @cached_property
    def misses(self) -> tuple[float, ...]:
        """Share of each mask that lies outside the hull of the others."""
        return tuple(self.outside(view) for view in range(len(self.depths)))

    @cached_property
    def takes(self) -> tuple[float, ...]:
        """Most of another mask that lies outside its hull because of each mask, as a share."""
        views = range(len(self.depths))
        taken = []
        for view in views:
            least = [self.misses[w] - self.outside(w, (view,)) for w in views if w != view and self.misses[w]]
            taken.append(max(least, default=0.0))
        return tuple(taken)

    @property
    def failed(self) -> Bool[np.ndarray, " V"]:
        """Which masks fail: they are outside the others' hull,
        or take from it what another needs."""
        return (np.array(self.misses) > MISSED) | (np.array(self.takes) > MISSED)


def _middle(photographs: tuple[Photograph, ...]) -> Float[np.ndarray, " 3"]:
    """The point nearest to the rays through the middles of all masks."""
    centers, across = [], []
    for photograph in photographs:
        middle = [(first + end) / 2 for first, end in reversed(photograph.extents)]
        rotation = photograph.extrinsics[:3, :3]
        ray = rotation.T @ np.linalg.solve(photograph.intrinsics, [*middle, 1.0])
        ray /= np.linalg.norm(ray)
        centers.append(-rotation.T @ photograph.extrinsics[:3, 3])
        across.append(np.eye(3) - np.outer(ray, ray))
    right = sum(matrix @ center for matrix, center in zip(across, centers, strict=True))
    return np.linalg.lstsq(sum(across), right, rcond=None)[0]


def _looked_up(
    photograph: Photograph, grid: np.ndarray, middle: np.ndarray, step: int
) -> tuple[np.ndarray, np.ndarray]:
    """Depths and cells of a grid's points in one view.

    Args:
        photograph: of the view.
        grid: points [n, 3] around the subject's middle, in the user's unit.
        middle: of the subject [3] in the world.
        step: side of a cell in pixels.

    Returns:
        Pixels inside the mask [n] float32, and number of the cell [n].
    """
    rotation = photograph.extrinsics[:3, :3]
    # in float64: worlds far from their origin
    shift = rotation @ middle + photograph.extrinsics[:3, 3]
    lens = photograph.intrinsics
    seen = grid.astype(np.float32) @ (lens @ rotation).T.astype(np.float32) + (lens @ shift).astype(
        np.float32
    )
    height, width = photograph.mask.shape
    ahead = seen[:, 2] > 0
    places = np.floor(seen[:, :2] / np.where(ahead, seen[:, 2], 1)[:, None]).astype(int)
    inside = ahead & (places >= 0).all(1) & (places < [width, height]).all(1)
    column, row = np.where(inside[:, None], places, 0).T
    ends = zip(photograph.extents, (height, width), strict=True)
    is_cut = any(first == 0 or last == side for (first, last), side in ends)
    beyond = 0.0 if is_cut else _NOWHERE
    depth = np.where(inside, signed_distance(photograph.mask)[row, column], beyond).astype(np.float32)
    cell = np.where(inside, row // step * -(-width // step) + column // step, -1)
    return depth, cell
