"""Test whether the masks and cameras of one instant agree.

Each mask is compared with the visual hull of the other masks, each outline with the edges of its photograph,
and cameras by how far rays near outlines miss the other silhouettes.

The points of a grid around the subject are projected into every mask. A pixel can show the subject only
if its ray passes a point that lies inside the other masks, which is their visual hull (Laurentini,
PAMI 1994).
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy import ndimage

from ghgs_capture.capture import Capture
from ghgs_capture.crops import SHARE, Photograph
from ghgs_lit.geometry.frame import Frame
from ghgs_lit.geometry.masks import signed_distance
from ghgs_lit.geometry.projection import meeting_point
from ghgs_lit.refinement.coherence import contradiction
from ghgs_lit.types import Batch

_POINTS = 56  #: Points of the grid along each axis
_LARGER = 1.4  #: Side of the grid, in heights of the subject
_NOWHERE = -99.0  #: Depth in the others' masks where a ray passes no point
#: A mask fails if more than this share of it lies outside the hull of the others, or if it removes
#: more than this share of another mask from that mask's hull.
MISSED = 0.01
CORRECTION = 4  #: Pixels by which masks, and rounds in which cameras are corrected
_REACH = 6  #: Pixels on each side of an outline within which contrast is measured
#: Mean distance, in pixels of the crop, of mask outlines from image edges above which masks are wrong.
_OFF = 0.35
#: Mean pixels by which rays near outlines miss other silhouettes, above which cameras are wrong.
_MISSED = 4e-3
#: The same limit if the other cameras agree without one camera, or without either of two
_MISSED_BY_FEW = 1.5e-3
_REST = 0.25  #: Share of the distance that remains without a camera, below which that camera may be wrong


def reach_of(size: tuple[int, int]) -> int:
    """Tolerance in pixels for errors of mask outlines and cameras.

    Args:
        size: (height, width) of a photograph in pixels.
    """
    return max(max(size) // 200, 2)


@dataclass(frozen=True)
class Agreement:
    """Signed distances of grid points from the outlines of the masks of one instant."""

    photographs: tuple[Photograph, ...]
    #: [V, n] pixels inside the mask of each view, negative outside; 0 (no information) for points
    #: outside a photograph whose border cuts the subject
    depths: Float[np.ndarray, "V n"]
    #: [V, n] cell of each point in each view, -1 outside the photograph
    cells: Float[np.ndarray, "V n"]
    steps: tuple[int, ...]  #: side of a cell in pixels, by view

    @classmethod
    def of(cls, capture: Capture) -> "Agreement | None":
        """Project a grid around the subject into all masks.

        Returns:
            The signed distances; None for fewer than three views, which cannot be compared.
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
            depth, cell = _look_up(photograph, grid, middle, steps[-1])
            depths.append(depth)
            cells.append(cell)
        return cls(photographs, np.stack(depths), np.stack(cells), tuple(steps))

    def depth_in_others(self, view: int, without: tuple[int, ...] = (), spare: int = 0) -> np.ndarray:
        """Compute how far the best point on each pixel's ray lies inside the other masks.

        Args:
            view: index of the view whose pixels are tested; its mask is excluded.
            without: indices of further views to exclude.
            spare: number of the other masks that a point may lie outside of.

        Returns:
            [h, w] float32 in pixels: the least distance over the other masks, ``_NOWHERE`` for rays
            without a point of the grid.
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
            view: index of the view whose mask is tested.
            without: indices of further views whose masks are excluded.
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
        """Largest share of another mask that lies outside its hull because of each mask."""
        views = range(len(self.depths))
        taken = []
        for view in views:
            least = [self.misses[w] - self.outside(w, (view,)) for w in views if w != view and self.misses[w]]
            taken.append(max(least, default=0.0))
        return tuple(taken)

    @property
    def failed(self) -> Bool[np.ndarray, " V"]:
        """Masks that lie outside the hull of the others, or that exclude part of another mask from its
        hull, by more than :data:`MISSED`."""
        return (np.array(self.misses) > MISSED) | (np.array(self.takes) > MISSED)


def _middle(photographs: tuple[Photograph, ...]) -> Float[np.ndarray, " 3"]:
    """The point nearest to the rays through the centres of all masks."""
    centers, rays = [], []
    for photograph in photographs:
        middle = [(first + end) / 2 for first, end in reversed(photograph.extents)]
        rotation = photograph.extrinsics[:3, :3]
        ray = rotation.T @ np.linalg.solve(photograph.intrinsics, [*middle, 1.0])
        rays.append(ray / np.linalg.norm(ray))
        centers.append(-rotation.T @ photograph.extrinsics[:3, 3])
    lines = (torch.from_numpy(np.stack(each)) for each in (centers, rays))
    return meeting_point(*lines).numpy()


def _look_up(
    photograph: Photograph, grid: np.ndarray, middle: np.ndarray, step: int
) -> tuple[np.ndarray, np.ndarray]:
    """Signed distance in pixels [n] float32 and cell index [n] of grid points [n, 3] around ``middle``."""
    rotation = photograph.extrinsics[:3, :3]
    # in float64 for worlds far from their origin
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


def doubt_of_masks(capture: Capture, size: tuple[int, int]) -> str:
    """Describe how far image edges lie from the outlines of the masks, if they contradict each other.

    Args:
        capture: photographs with their masks.
        size: (height, width) of the crops in pixels.

    Returns:
        A message with the distance of each mask's outline from the image edge, in pixels of the crop,
        positive inward; "" if the masks are right.
    """
    off = [_outline(photograph, size) for photograph in capture.photographs]
    if np.abs(off).mean() <= _OFF:
        return ""
    return f"photographs show outlines {', '.join(f'{n:+.1f}' for n in off)} pixels inside the masks'"


def doubt_of_cameras(capture: Capture, batch: Batch) -> str:
    """Describe by how much silhouettes miss one another, if cameras are wrong.

    The message also names the cameras without which the others agree: one, or two that are nearly
    exchangeable, such as opposite ones.

    Args:
        capture: photographs with their cameras.
        batch: crops of ``capture``, a batch of one element.

    Returns:
        The message; "" if the cameras are right.
    """
    missed, without = (distances[0].tolist() for distances in contradiction(Frame.of(batch).enter(batch)))
    focal = [photograph.intrinsics[0, 0] for photograph in capture.photographs]
    # An enlarged photograph has larger pixels, and larger steps of outlines.
    larger = max(1.0, *(batch.cameras.intrinsics[0, :, 0, 0].numpy() / focal))
    rest = {}
    for name, distance in zip(batch.views[0], without, strict=True):
        if distance < _REST * missed:
            rest[name] = distance
    is_of_few = 0 < 2 * len(rest) <= len(without)
    if missed <= larger**2 * (_MISSED_BY_FEW if is_of_few else _MISSED):
        return ""
    without_few = f", without {' or '.join(rest)} by {max(rest.values()):.4f}" if is_of_few else ""
    return f"silhouettes miss one another by {missed:.4f} pixels{without_few}"


def _outline(photograph: Photograph, size: tuple[int, int]) -> float:
    """Distance in pixels of the crop, inward from the mask's outline, at which the photograph has the
    most contrast."""
    extents = photograph.extents
    steps = [(end - start) / (SHARE * side) for (start, end), side in zip(extents, size, strict=True)]
    step = max(*steps, 1)
    reach = (_REACH + 2) * step
    # One pixel of the photograph for each of the crop is fast and keeps the positions of edges.
    lines = [
        np.arange(max(start - reach, 0), min(end - 1 + reach, whole - 1) + 0.5, step).astype(int)
        for (start, end), whole in zip(extents, photograph.mask.shape, strict=True)
    ]
    seen = np.ix_(*lines)
    distance = signed_distance(photograph.mask[seen])
    near = np.abs(distance) < _REACH
    if not near.any():
        return 0.0
    slopes = np.gradient(photograph.image[seen].astype(np.float32), axis=(0, 1))
    pairs = zip(slopes, np.gradient(distance), strict=True)
    across = sum(slope[near] * n[near][:, None] for slope, n in pairs)
    lines = np.floor(distance[near]).astype(int) + _REACH
    count = np.maximum(np.bincount(lines, minlength=2 * _REACH), 1)
    contrast = np.bincount(lines, np.abs(across).sum(-1), 2 * _REACH) / count
    # The mean over four lines of pixels around the edge gives fractions of a pixel.
    first = int((contrast[1:-2] + contrast[2:-1]).argmax())
    around = contrast[first : first + 4]
    middle = (around * np.arange(4)).sum() / max(around.sum(), 1e-6)
    return float(first + middle - _REACH + 0.5) * step / max(steps)
