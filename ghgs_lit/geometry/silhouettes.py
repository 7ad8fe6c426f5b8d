"""Silhouette coherence: how much of each mask is explained by the visual hull of the others.

With correct cameras and masks, the ray of every mask pixel passes through a point that all other
masks cover (Boyer, 2006; Hernandez, Schmitt and Cipolla, 2007). Silhouettes may differ in size, unlike
in :mod:`ghgs_lit.method.bounds.agreement`."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np


@dataclass(frozen=True)
class Silhouette:
    """A mask at the resolution of cells (blocks of pixels) with its camera.

    Attributes:
        mask: [h, w] bool, True where any pixel of a cell is.
        intrinsics: [3, 3] float64, in cells.
        extrinsics: world to camera [4, 4] float64.
    """

    mask: np.ndarray
    intrinsics: np.ndarray
    extrinsics: np.ndarray

    @property
    def center(self) -> np.ndarray:
        """Centre of the camera [3] in the world."""
        return -self.extrinsics[:3, :3].T @ self.extrinsics[:3, 3]

    @cached_property
    def grown(self) -> np.ndarray:
        """The mask [h, w] dilated by one cell."""
        padded = np.pad(self.mask, 1)
        height, width = self.mask.shape
        shifts = (padded[row : row + height, column : column + width] for row, column in np.ndindex(3, 3))
        return np.logical_or.reduce(list(shifts))

    def rays(self, cells: np.ndarray) -> np.ndarray:
        """Directions [n, 3] in the world, per unit of depth z, of rays through ``cells`` [n, 2]
        (column, row)."""
        local = np.concatenate((cells, np.ones((len(cells), 1))), 1) @ np.linalg.inv(self.intrinsics).T
        return local @ self.extrinsics[:3, :3]

    def depths_around(self, point: np.ndarray, reach: float, count: int) -> np.ndarray:
        """Evenly spaced depths around the depth of a point.

        Args:
            point: [3] in the world.
            reach: largest distance from the point's depth, in the unit of the world.
            count: number of depths.

        Returns:
            The positive ones of ``count`` depths z, ascending.
        """
        middle = (self.extrinsics[:3, :3] @ point + self.extrinsics[:3, 3])[2]
        depths = middle + reach * np.linspace(-1, 1, count)
        return depths[depths > 0]

    def covers(self, points: np.ndarray) -> np.ndarray:
        """Whether world points [..., 3] project into the dilated mask; False behind the camera.

        Outside the frame the nearest border cell counts, since a subject that touches the border
        continues beyond it.
        """
        local = points @ self.extrinsics[:3, :3].T + self.extrinsics[:3, 3]
        z = local[..., 2]
        pixels = local @ self.intrinsics.T
        cells = np.nan_to_num(np.floor(pixels[..., :2] / np.where(z > 0, z, 1)[..., None]))
        row, column = (
            cells[..., 1 - i].clip(0, side - 1).astype(int) for i, side in enumerate(self.mask.shape)
        )
        return self.grown[row, column] & (z > 0)

    def extent(self, focus: np.ndarray) -> np.ndarray:
        """Height and width [2] of the mask at the depth of ``focus`` [3], in the unit of the world; 0
        for an empty mask."""
        rows, columns = np.nonzero(self.mask)
        cells = np.array([np.ptp(rows) + 1, np.ptp(columns) + 1]) if len(rows) else np.zeros(2)
        depth = abs((self.extrinsics[:3, :3] @ focus + self.extrinsics[:3, 3])[2])
        return cells * depth / self.intrinsics[[1, 0], [1, 0]]


@dataclass(frozen=True)
class HullSearch:
    """Precision of a search for the visual hull."""

    rays: int = 300  # largest number of cells per mask
    depths: int = 96  # points along each ray
    reach: float = 1.25  # range of depths around the subject's centre, in radii of the subject
    # largest number of other silhouettes that a ray is compared with; None: all
    others: int | None = None
    wrong: float = 0.0  # fraction of these that need not cover a point of the hull

    def shares(self, silhouettes: Sequence[Silhouette]) -> list[float]:
        """Fraction of each silhouette's cells whose rays meet the visual hull of the others.

        Args:
            silhouettes: of one subject at one instant.

        Returns:
            A fraction in [0, 1] per silhouette; 0 if it is empty.
        """
        count = len(silhouettes) if self.others is None else self.others + 1
        spread = np.unique(np.linspace(0, len(silhouettes) - 1, count).round().astype(int))
        focus, radius = subject_sphere(silhouettes)
        shares = []
        for i, one in enumerate(silhouettes):
            cells = np.argwhere(one.mask)[:, ::-1] + 0.5
            if len(cells):
                cells = cells[np.unique(np.linspace(0, len(cells) - 1, self.rays).astype(int))]
            meets = self.meets(one, cells, [silhouettes[j] for j in spread if j != i], focus, radius)
            shares.append(float(meets.mean()) if len(meets) else 0.0)
        return shares

    def meets(
        self,
        one: Silhouette,
        cells: np.ndarray,
        others: Sequence[Silhouette],
        focus: np.ndarray,
        radius: float,
    ) -> np.ndarray:
        """Whether each ray of one silhouette meets the visual hull of others.

        Args:
            one: the silhouette that the rays belong to.
            cells: points in its mask that the rays pass through [n, 2] (column, row); the centre of
                the first cell is (0.5, 0.5).
            others: silhouettes of the hull; a fraction :attr:`wrong` of them need not cover a point.
            focus: the subject's centre [3] (:func:`subject_sphere`).
            radius: radius of the subject, in the unit of the world.
        """
        depths = one.depths_around(focus, self.reach * radius, self.depths)
        points = one.center + one.rays(cells)[:, None] * depths[:, None]
        outside = np.zeros(points.shape[:2], int)
        allowed = int(self.wrong * len(others))
        for other in others:
            open_points = outside <= allowed
            outside[open_points] += ~other.covers(points[open_points])
        return (outside <= allowed).any(1)


def subject_sphere(silhouettes: Sequence[Silhouette]) -> tuple[np.ndarray, float]:
    """Centre [3] of the subject in the world, and an upper bound of its radius in the world's unit.

    Args:
        silhouettes: of one subject at one instant.
    """
    # Imported late, so that checks of paths do not load PyTorch.
    import torch

    from ghgs_lit.geometry.projection import meeting_point

    rays = []
    centers = np.stack([s.center for s in silhouettes])
    for s in silhouettes:
        rows, columns = np.nonzero(s.mask)
        cells = np.array([[columns.mean(), rows.mean()]]) + 0.5 if len(rows) else np.zeros((1, 2))
        ray = s.rays(cells)[0]
        rays.append(ray / np.linalg.norm(ray))
    meeting = meeting_point(*(torch.from_numpy(np.stack(each)) for each in (centers, rays)))
    focus = meeting.numpy()
    return focus, float(max(np.linalg.norm(s.extent(focus)) for s in silhouettes))


def median_height(silhouettes: Sequence[Silhouette]) -> float:
    """Median height in the world's unit of the subject of several silhouettes."""
    focus, _ = subject_sphere(silhouettes)
    return float(np.median([s.extent(focus)[0] for s in silhouettes]))
