"""How well masks and cameras agree: each mask must lie within the visual hull of the others.

Where cameras and masks are right, the ray of every mask pixel passes a point that all other masks cover
(silhouette consistency: Boyer 2006; Hernandez, Schmitt and Cipolla 2007).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from ghgs_lit.data.silhouettes import Silhouette, subject_place

# Rays of a mask that are tried, depths along each, and cells by which the other masks are grown.
_RAYS, _DEPTHS, _GROWN = 300, 96, 1
# The range of depths that is searched, in radii of the subject about its middle.
_REACH = 1.25


@dataclass(frozen=True)
class Covers:
    """Looks up world points in a silhouette that is grown by ``_GROWN`` cells."""

    silhouette: Silhouette
    grown: np.ndarray

    @classmethod
    def of(cls, silhouette: Silhouette) -> "Covers":
        size = 2 * _GROWN + 1
        return cls(silhouette, ndimage.binary_dilation(silhouette.mask, np.ones((size, size))))

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Whether points [..., 3] are covered; beyond the frame counts what is at its border."""
        s = self.silhouette
        local = points @ s.extrinsics[:3, :3].T + s.extrinsics[:3, 3]
        front = local[..., 2] > 0
        pixels = local @ s.intrinsics.T
        cells = np.floor(pixels[..., :2] / np.where(front, pixels[..., 2], 1)[..., None])
        height, width = self.grown.shape
        row = np.nan_to_num(cells[..., 1]).clip(0, height - 1).astype(int)
        column = np.nan_to_num(cells[..., 0]).clip(0, width - 1).astype(int)
        return self.grown[row, column] & front


def agreements(silhouettes: Sequence[Silhouette]) -> np.ndarray:
    """For each silhouette the share [V] of its rays that meet the hull of the others; 0 where empty."""
    covers = [Covers.of(s) for s in silhouettes]
    focus, radius = subject_place(silhouettes)
    shares = []
    for i, own in enumerate(silhouettes):
        cells = np.argwhere(own.mask)[:, ::-1]
        chosen = np.unique(np.linspace(0, len(cells) - 1, _RAYS).astype(int)) if len(cells) else []
        met = meets_hull(own, cells[chosen] + 0.5, [c for j, c in enumerate(covers) if j != i], focus, radius)
        shares.append(float(met.mean()) if len(met) else 0.0)
    return np.array(shares)


def meets_hull(
    own: Silhouette, cells: np.ndarray, others: Sequence[Covers], focus: np.ndarray, radius: float
) -> np.ndarray:
    """Whether the rays through ``cells`` [n, 2] (column, row) pass a point that all ``others`` cover [n]."""
    middle = (own.extrinsics[:3, :3] @ focus + own.extrinsics[:3, 3])[2]
    depths = middle + _REACH * radius * np.linspace(-1, 1, _DEPTHS)
    depths = depths[depths > 0]
    if not len(depths) or not len(cells):
        return np.zeros(len(cells), bool)
    points = own.center + own.rays(cells)[:, None] * depths[:, None]
    inside = np.ones(points.shape[:2], bool)
    for other in others:
        inside[inside] = other(points[inside])
    return inside.any(1)


def hull_outline(silhouettes: Sequence[Silhouette], index: int) -> np.ndarray:
    """Where the visual hull of the other silhouettes lies in the cells of one of them [h, w] bool."""
    own = silhouettes[index]
    focus, radius = subject_place(silhouettes)
    rows, columns = np.indices(own.mask.shape)
    cells = np.stack((columns.ravel(), rows.ravel()), -1) + 0.5
    others = [Covers.of(s) for j, s in enumerate(silhouettes) if j != index]
    return meets_hull(own, cells, others, focus, radius).reshape(own.mask.shape)
