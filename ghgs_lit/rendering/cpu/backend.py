"""The CPU backend as one differentiable function of PyTorch."""

from dataclasses import dataclass
from functools import partial
from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ghgs_lit.rendering.cpu import binning, layout, pool, projection, raster
from ghgs_lit.rendering.settings import RasterSettings
from ghgs_lit.types import Cameras, Gaussians

# Tiles are handed to threads in runs of about this many per thread, so that none waits long for the last.
_RUNS = 8


def render_sums(
    gaussians: Gaussians, cameras: Cameras, settings: RasterSettings, near: float, far: float
) -> Float[Tensor, "B T channels h w"]:
    """Sums over the Gaussians of a pixel: ``w colour`` (C channels), ``w z`` and ``w``; float32.

    Differentiable in the Gaussians, not in the cameras. The same bits with any number of threads.
    """
    fields = (gaussians.means, gaussians.quaternions, gaussians.scales, gaussians.opacities, gaussians.colors)
    plan = _Plan.of(gaussians, cameras, settings, near, far)
    image = _Rasterize.apply(*(field.float().contiguous() for field in fields), plan)
    return image.unflatten(0, cameras.shape)


@dataclass(frozen=True)
class _Plan:
    """What to render, without the Gaussians' values. View ``v`` shows element ``v // T``."""

    views: np.ndarray
    first_gaussians: np.ndarray
    counts: np.ndarray
    views_each: int
    height: int
    width: int
    settings: RasterSettings
    near: float
    far: float

    @classmethod
    def of(cls, gaussians, cameras, settings, near, far) -> "_Plan":
        views_each = cameras.shape[1]
        splits = np.array(gaussians.splits, dtype=np.int64)
        return cls(
            views=_view_rows(cameras, settings),
            first_gaussians=np.repeat(np.cumsum(splits) - splits, views_each),
            counts=np.repeat(splits, views_each),
            views_each=views_each,
            height=cameras.height,
            width=cameras.width,
            settings=settings,
            near=near,
            far=far,
        )

    @property
    def tiles(self) -> tuple[int, int]:
        """Tiles across and down one view."""
        return -(-self.width // layout.TILE), -(-self.height // layout.TILE)


def _view_rows(cameras: Cameras, settings: RasterSettings) -> np.ndarray:
    """The cameras as rows of ``layout.VIEW`` doubles."""
    intrinsics = cameras.intrinsics.detach().double().flatten(0, -3).numpy()
    extrinsics = cameras.extrinsics.detach().double().flatten(0, -3).numpy()
    rows = np.zeros((len(intrinsics), layout.VIEW))
    sides = ((0, cameras.width, layout.X_LOW), (1, cameras.height, layout.Y_LOW))
    for axis, size, low in sides:
        focal, center = intrinsics[:, axis, axis], intrinsics[:, axis, 2]
        margin = settings.frustum_margin * 0.5 * size / focal
        rows[:, layout.FX + axis], rows[:, layout.CX + axis] = focal, center
        rows[:, low], rows[:, low + 1] = -center / focal - margin, (size - center) / focal + margin
    rows[:, layout.ROTATION : layout.ROTATION + 9] = extrinsics[:, :3, :3].reshape(-1, 9)
    rows[:, layout.TRANSLATION : layout.TRANSLATION + 3] = extrinsics[:, :3, 3]
    return rows


@dataclass
class _Splats:
    """Splats of all views, and the entries of all tiles; see ``layout``."""

    shifts: np.ndarray
    starts: np.ndarray
    roots: np.ndarray
    records: np.ndarray
    rects: np.ndarray
    entry_starts: np.ndarray
    tile_starts: np.ndarray
    splats: np.ndarray
    slots: np.ndarray
    hits: np.ndarray


def _prepare(plan: _Plan, means, quaternions, scales, opacities) -> _Splats:
    """Project all Gaussians into their views, sort them and list them by tile."""
    settings, (tiles_x, tiles_y) = plan.settings, plan.tiles
    views, tiles = len(plan.views), tiles_x * tiles_y
    starts = np.cumsum(plan.counts) - plan.counts
    total = int(plan.counts.sum())
    roots = np.empty((len(means), 9))
    records = np.empty((total, layout.RECORD), np.float32)
    depths, rects = np.empty(total, np.float32), np.empty((total, 4), np.int32)
    tile_counts = np.zeros(views * tiles + 1, np.int64)
    shifts = plan.first_gaussians - starts
    seen = np.zeros(views, np.int64)
    pool.run([partial(projection.roots, quaternions, scales, a, b, roots) for a, b in _parts(len(means))])

    def project(v: int) -> None:
        seen[v] = projection.project(
            means,
            roots,
            opacities,
            plan.views[v],
            starts[v],
            plan.counts[v],
            shifts[v],
            plan.near,
            plan.far,
            settings.low_pass,
            settings.alpha_min,
            settings.extent,
            settings.antialiased,
            plan.height,
            plan.width,
            records,
            depths,
            rects,
            tile_counts[1 + v * tiles : 1 + (v + 1) * tiles],
        )

    pool.run([partial(project, v) for v in range(views)])
    tile_starts = np.cumsum(tile_counts)
    entry_starts = np.zeros(total + 1, np.int64)
    np.cumsum((rects[:, 1] - rects[:, 0]) * (rects[:, 3] - rects[:, 2]), out=entry_starts[1:])
    splats, slots = np.empty(tile_starts[-1], np.int32), np.empty(tile_starts[-1], np.int64)

    def scatter(v: int) -> None:
        binning.scatter(
            depths,
            rects,
            starts[v],
            plan.counts[v],
            seen[v],
            tiles_x,
            tile_starts,
            v * tiles,
            entry_starts,
            splats,
            slots,
        )

    pool.run([partial(scatter, v) for v in range(views)])
    hits = np.empty(len(splats), np.uint16)
    return _Splats(shifts, starts, roots, records, rects, entry_starts, tile_starts, splats, slots, hits)


def _parts(count: int) -> list[tuple[int, int]]:
    """``count`` things in one run for each thread."""
    edges = np.linspace(0, count, min(torch.get_num_threads(), max(1, count)) + 1).astype(np.int64)
    return [(int(a), int(b)) for a, b in pairwise(edges)]


def _tile_runs(tile_starts: np.ndarray) -> list[np.ndarray]:
    """Tiles that have entries, in runs of about equal work."""
    counts = np.diff(tile_starts)
    tiles = np.flatnonzero(counts)
    threads = torch.get_num_threads()
    if threads == 1 or len(tiles) < 2:
        return [tiles] if len(tiles) else []
    work = np.cumsum(counts[tiles])
    edges = np.searchsorted(work, work[-1] * np.arange(1, threads * _RUNS) / (threads * _RUNS))
    return [run for run in np.split(tiles, edges) if len(run)]


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(ctx, means, quaternions, scales, opacities, colors, plan: _Plan) -> Tensor:
        arrays = [t.detach().numpy() for t in (means, quaternions, scales, opacities, colors)]
        found = _prepare(plan, *arrays[:4])
        image = torch.zeros(len(plan.views), colors.shape[1] + 2, plan.height, plan.width)
        settings = plan.settings
        pool.run(
            [
                partial(
                    raster.forward,
                    run,
                    *plan.tiles,
                    found.tile_starts,
                    found.splats,
                    found.shifts,
                    found.records,
                    arrays[4],
                    np.float32(settings.alpha_max),
                    np.float32(settings.stop),
                    found.hits,
                    image.numpy(),
                )
                for run in _tile_runs(found.tile_starts)
            ]
        )
        ctx.save_for_backward(means, quaternions, scales, opacities, colors, image)
        ctx.plan, ctx.found = plan, found
        return image

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, image_gradient: Tensor):
        *inputs, image = ctx.saved_tensors
        means, quaternions, scales, _, colors = (t.detach().numpy() for t in inputs)
        plan, found, settings = ctx.plan, ctx.found, ctx.plan.settings
        width = layout.gradient_width(colors.shape[1])
        gradients = np.empty((len(found.splats), width), np.float32)
        upstream = image_gradient.float().contiguous().numpy()
        pool.run(
            [
                partial(
                    raster.backward,
                    run,
                    *plan.tiles,
                    found.tile_starts,
                    found.splats,
                    found.slots,
                    found.shifts,
                    found.records,
                    colors,
                    np.float32(settings.alpha_max),
                    np.float32(settings.stop),
                    found.hits,
                    image.numpy(),
                    upstream,
                    gradients,
                )
                for run in _tile_runs(found.tile_starts)
            ]
        )
        results = [torch.zeros_like(t) for t in inputs]
        arrays = [t.numpy() for t in results]
        tasks = []
        for first_view in range(0, len(plan.views), max(1, plan.views_each)):
            start = int(plan.first_gaussians[first_view])
            for a, b in _parts(int(plan.counts[first_view])):
                tasks.append(
                    partial(
                        projection.unproject,
                        means,
                        quaternions,
                        scales,
                        found.roots,
                        plan.views,
                        first_view,
                        first_view + plan.views_each,
                        start + a,
                        start + b,
                        found.shifts,
                        settings.low_pass,
                        settings.antialiased,
                        found.records,
                        found.rects,
                        found.entry_starts,
                        gradients,
                        *arrays,
                    )
                )
        pool.run(tasks)
        return *results, None
