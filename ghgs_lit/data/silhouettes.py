"""Whether the masks of a person fit one another: a check of cameras that needs no body.

Where all cameras and masks are right, the ray of every mask pixel meets the visual hull of the other masks.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from ghgs_lit.data.resampling import area_mask
from ghgs_lit.data.view import View

# Side of a mask in cells, at most, and how many of its cells and depths along their rays are tried.
_CELLS, _RAYS, _DEPTHS = 64, 200, 64
# How many other masks a ray is looked up in, and the share of them that may be wrong.
_OTHERS, _WRONG = 12, 0.25
# A person covers more of a photograph than this, and less of its border than that.
_LEAST_SHARE, _MOST_BORDER = 1e-3, 0.5


@dataclass(frozen=True)
class Silhouette:
    """A coarse mask with the camera of its cells.

    Attributes:
        mask: [h, w] bool, true where any pixel of a cell is.
        intrinsics: [3, 3] float64 in cells, cell centres at +0.5.
        extrinsics: [4, 4] float64, world to camera.
    """

    mask: np.ndarray
    intrinsics: np.ndarray
    extrinsics: np.ndarray

    @property
    def center(self) -> np.ndarray:
        """The camera's centre [3] in the world."""
        return -self.extrinsics[:3, :3].T @ self.extrinsics[:3, 3]

    def rays(self, cells: np.ndarray) -> np.ndarray:
        """World directions [n, 3] of z 1 in the camera, through ``cells`` [n, 2] (column, row)."""
        local = np.concatenate((cells, np.ones((len(cells), 1))), 1) @ np.linalg.inv(self.intrinsics).T
        return local @ self.extrinsics[:3, :3]

    def covers(self, points: np.ndarray) -> np.ndarray:
        """Whether world points [..., 3] lie in the mask or in a cell beside it; false behind the camera.

        Beyond the frame counts what is at its border: a mask that touches it goes on.
        """
        local = points @ self.extrinsics[:3, :3].T + self.extrinsics[:3, 3]
        z = local[..., 2]
        pixels = local @ self.intrinsics.T
        cells = np.floor(pixels[..., :2] / np.where(z > 0, z, 1)[..., None])
        grown = ndimage.binary_dilation(self.mask, np.ones((3, 3)))
        row, column = (cells[..., 1 - i].clip(0, side - 1).astype(int) for i, side in enumerate(grown.shape))
        return grown[row, column] & (z > 0)


def silhouette(view: View) -> Silhouette:
    """The coarse silhouette of a photograph."""
    height, width = view.mask.shape
    scale = min(_CELLS / max(height, width), 1)
    size = max(round(height * scale), 1), max(round(width * scale), 1)
    intrinsics = view.intrinsics.astype(np.float64)
    intrinsics[:2] *= np.array([[size[1] / width], [size[0] / height]])
    return Silhouette(area_mask(view.mask, *size), intrinsics, view.extrinsics.astype(np.float64))


def implausible(mask: np.ndarray) -> str | None:
    """What is wrong with a mask [h, w] by itself: too small, or full or inverted; None if nothing is."""
    border = np.concatenate((mask[0], mask[-1], mask[:, 0], mask[:, -1])).mean()
    if border > _MOST_BORDER:
        return (
            f"expected a mask of the subject, not of the background; found {border:.0%} of the border in it"
        )
    if mask.mean() < _LEAST_SHARE:
        return (
            f"expected a subject of {_LEAST_SHARE:.1%} of the photograph or more; found {mask.sum()} pixels"
        )
    return None


def supports(silhouettes: Sequence[Silhouette]) -> list[float]:
    """For each silhouette the share of its cells whose rays meet the visual hull of the others."""
    focus, radius = subject_place(silhouettes)
    return [
        _support(s, [o for o in _some(silhouettes, _OTHERS + 1) if o is not s], focus, radius)
        for s in silhouettes
    ]


def height(silhouettes: Sequence[Silhouette]) -> float:
    """Median height of the subject in world units, as the silhouettes show it."""
    focus, _ = subject_place(silhouettes)
    return float(np.median([extent(s, focus)[0] for s in silhouettes]))


def twins(silhouettes: Mapping[int, Silhouette]) -> tuple[int, int] | None:
    """The first two positions whose cameras are the same; None if all differ."""
    listed = list(silhouettes.items())
    for i, (first, one) in enumerate(listed):
        for second, other in listed[i + 1 :]:
            if np.allclose(one.extrinsics, other.extrinsics, atol=1e-6):
                return first, second
    return None


def _support(own: Silhouette, others: Sequence[Silhouette], focus: np.ndarray, radius: float) -> float:
    rows, columns = np.nonzero(own.mask)
    if not len(rows):
        return 0.0
    chosen = np.unique(np.linspace(0, len(rows) - 1, _RAYS).astype(int))
    rays = own.rays(np.stack((columns, rows), -1)[chosen] + 0.5)
    middle = (own.extrinsics[:3, :3] @ focus + own.extrinsics[:3, 3])[2]
    depths = middle + radius * np.linspace(-1, 1, _DEPTHS)
    depths = depths[depths > 0]
    points = own.center + rays[:, None] * depths[:, None]
    votes = np.sum([other.covers(points) for other in others], 0)
    needed = len(others) - int(_WRONG * len(others))
    return float((votes >= needed).any(1).mean()) if len(depths) else 0.0


def subject_place(silhouettes: Sequence[Silhouette]) -> tuple[np.ndarray, float]:
    """Where the subject is [3], and how far its parts may lie from there."""
    rays, centers = [], np.stack([s.center for s in silhouettes])
    for s in silhouettes:
        rows, columns = np.nonzero(s.mask)
        cells = np.array([[columns.mean(), rows.mean()]]) + 0.5 if len(rows) else np.zeros((1, 2))
        ray = s.rays(cells)[0]
        rays.append(ray / np.linalg.norm(ray))
    # The point nearest to all rays: sum (I - r r^T) (x - c) = 0.
    across = np.eye(3) - np.einsum("ni,nj->nij", rays, rays)
    focus = np.linalg.lstsq(across.sum(0), np.einsum("nij,nj->i", across, centers), rcond=None)[0]
    return focus, float(max(np.linalg.norm(extent(s, focus)) for s in silhouettes))


def extent(s: Silhouette, focus: np.ndarray) -> np.ndarray:
    """Height and width [2] of a silhouette at the depth of ``focus``, in world units."""
    rows, columns = np.nonzero(s.mask)
    cells = np.array([np.ptp(rows) + 1, np.ptp(columns) + 1]) if len(rows) else np.zeros(2)
    depth = abs((s.extrinsics[:3, :3] @ focus + s.extrinsics[:3, 3])[2])
    return cells * depth / s.intrinsics[[1, 0], [1, 0]]


def _some(items: Sequence[Silhouette], count: int) -> list[Silhouette]:
    return [items[i] for i in np.unique(np.linspace(0, len(items) - 1, count).round().astype(int))]
