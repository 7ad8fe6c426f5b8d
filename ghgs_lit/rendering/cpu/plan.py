"""What one call of the CPU backend renders: cameras, parts of the Gaussians, sizes of the arrays."""

from dataclasses import dataclass

import numpy as np
import torch

from ghgs_lit.kernels import pool, simd
from ghgs_lit.rendering.cpu import layout
from ghgs_lit.rendering.settings import RasterSettings
from ghgs_lit.types import Cameras


@dataclass(frozen=True)
class Plan:
    """What to render, without the values of the Gaussians. View ``v`` shows batch element ``v // T``.

    ``views`` are the cameras as rows of ``layout.VIEW`` doubles; ``edges`` [B, P + 1] bound the parts of each
    element; Gaussian ``n`` is splat ``n + shifts[v]`` of view ``v``; ``splats`` counts those of all views;
    ``shape`` is (B, T).
    """

    views: np.ndarray
    edges: np.ndarray
    shifts: np.ndarray
    splats: int
    shape: tuple[int, int]
    height: int
    width: int
    settings: RasterSettings
    near: float
    far: float

    @classmethod
    def of(cls, gaussians, cameras, settings, near, far) -> "Plan":
        counts, views_each = np.array(gaussians.splits, dtype=np.int64), cameras.shape[1]
        firsts = np.cumsum(counts) - counts
        # Each view has whole vectors of splats, so that two threads never write to the same vector.
        sizes = np.repeat(-(-counts // simd.DOUBLES) * simd.DOUBLES, views_each)
        return cls(
            views=_view_rows(cameras, settings),
            edges=_part_edges(firsts, counts),
            shifts=np.cumsum(sizes) - sizes - np.repeat(firsts, views_each),
            splats=int(sizes.sum()),
            shape=tuple(cameras.shape),
            height=cameras.height,
            width=cameras.width,
            settings=settings,
            near=near,
            far=far,
        )

    @property
    def tiles(self) -> tuple[int, int]:
        """Number of tiles across and down a view."""
        return -(-self.width // layout.TILE), -(-self.height // layout.TILE)

    @property
    def constants(self) -> tuple[np.float32, np.float32]:
        """``alpha_max`` and ``stop``."""
        return np.float32(self.settings.alpha_max), np.float32(self.settings.stop)

    @property
    def parts(self) -> list[tuple[int, int, int, int, slice]]:
        """Each part as (batch element, part, first Gaussian, last Gaussian, views of the element)."""
        views = self.shape[1]
        return [
            (b, p, int(edges[p]), int(edges[p + 1]), slice(b * views, (b + 1) * views))
            for b, edges in enumerate(self.edges)
            for p in range(len(edges) - 1)
            if edges[p] < edges[p + 1]
        ]


def _part_edges(firsts: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Where the parts of each element begin and end [B, P + 1]; all but the last are whole vectors."""
    threads, total = torch.get_num_threads(), int(counts.sum())
    parts = 1 if threads == 1 else max(1, min(-(-2 * threads // max(1, len(counts))), total // pool.GRAIN))
    steps = -(-counts // (parts * simd.DOUBLES)) * simd.DOUBLES
    edges = np.minimum(steps[:, None] * np.arange(parts + 1), counts[:, None])
    return edges + firsts[:, None]


def _view_rows(cameras: Cameras, settings: RasterSettings) -> np.ndarray:
    intrinsics = cameras.intrinsics.detach().double().flatten(0, -3).numpy()
    extrinsics = cameras.extrinsics.detach().double().flatten(0, -3).numpy()
    rows = np.zeros((len(intrinsics), layout.VIEW))
    sides = ((0, cameras.width, layout.X_LOW), (1, cameras.height, layout.Y_LOW))
    for axis, size, low in sides:
        focal, center = intrinsics[:, axis, axis], intrinsics[:, axis, 2]
        margin = settings.frustum_margin * 0.5 * size / focal
        rows[:, layout.FX + axis], rows[:, layout.CX + axis] = focal, center
        rows[:, low], rows[:, low + 1] = -center / focal - margin, (size - center) / focal + margin
    rows[:, layout.RIGHT], rows[:, layout.BOTTOM] = cameras.width - 1, cameras.height - 1
    rows[:, layout.ROTATION : layout.ROTATION + 9] = extrinsics[:, :3, :3].reshape(-1, 9)
    rows[:, layout.TRANSLATION : layout.TRANSLATION + 3] = extrinsics[:, :3, 3]
    return rows
