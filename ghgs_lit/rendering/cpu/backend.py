"""The CPU backend as one differentiable function of PyTorch."""

from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from jaxtyping import Int
from torch import Tensor

from ghgs_lit.rendering.cpu import binning, gradients, layout, pool, projection, raster, simd
from ghgs_lit.rendering.settings import RasterSettings
from ghgs_lit.types import Cameras, Gaussians, Rendering

# Tiles are handed to threads in runs of about this many per thread, so that none waits long for the last.
_RUNS = 8
# The kernels are compiled for this number of channels, and once more for all others.
_COLORS = 3


def rasterize(
    gaussians: Gaussians,
    cameras: Cameras,
    settings: RasterSettings,
    near: float,
    far: float,
    regions: Int[Tensor, "B T 4"] | None = None,
) -> Rendering:
    """Gaussians on black, in float32; see :func:`ghgs_lit.rendering.render`.

    Outside of ``regions`` (top, left, height, width) nothing is drawn, nor computed.

    Differentiable in the Gaussians, not in the cameras. The same bits with any number of threads.
    """
    fields = (gaussians.means, gaussians.quaternions, gaussians.scales, gaussians.opacities, gaussians.colors)
    plan = _Plan.of(gaussians, cameras, settings, near, far, regions)
    return Rendering(*_Rasterize.apply(*(field.float().contiguous() for field in fields), plan))


@dataclass(frozen=True)
class _Plan:
    """What to render, without the Gaussians' values. View ``v`` shows batch element ``v // T``."""

    views: np.ndarray
    first_gaussians: np.ndarray
    counts: np.ndarray
    shape: tuple[int, int]
    height: int
    width: int
    settings: RasterSettings
    near: float
    far: float

    @classmethod
    def of(cls, gaussians, cameras, settings, near, far, regions) -> "_Plan":
        splits, views_each = np.array(gaussians.splits, dtype=np.int64), cameras.shape[1]
        return cls(
            views=_view_rows(cameras, settings, regions),
            first_gaussians=np.repeat(np.cumsum(splits) - splits, views_each),
            counts=np.repeat(splits, views_each),
            shape=tuple(cameras.shape),
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

    @property
    def constants(self) -> tuple[np.float32, np.float32]:
        return np.float32(self.settings.alpha_max), np.float32(self.settings.stop)


def _view_rows(cameras: Cameras, settings: RasterSettings, regions: Tensor | None) -> np.ndarray:
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
    rows[:, layout.RIGHT], rows[:, layout.BOTTOM] = cameras.width - 1, cameras.height - 1
    if regions is not None:
        top, left, height, width = regions.cpu().double().flatten(0, -2).numpy().T
        rows[:, layout.LEFT], rows[:, layout.RIGHT] = left, left + width - 1
        rows[:, layout.TOP], rows[:, layout.BOTTOM] = top, top + height - 1
    rows[:, layout.ROTATION : layout.ROTATION + 9] = extrinsics[:, :3, :3].reshape(-1, 9)
    rows[:, layout.TRANSLATION : layout.TRANSLATION + 3] = extrinsics[:, :3, 3]
    return rows


@dataclass
class _Splats:
    """Splats of all views, and the entries of all tiles; see ``layout``."""

    shifts: np.ndarray
    shared: np.ndarray
    stride: int
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
    total, stride = int(plan.counts.sum()), len(means) + simd.DOUBLES
    shifts = plan.first_gaussians - starts
    shared = np.empty(layout.SHARED * stride)
    records = np.empty((total, layout.RECORD), np.float32)
    depths, rects = np.empty(total, np.float32), np.empty((total, 4), np.int32)
    tile_counts = np.zeros(views * tiles + 1, np.int64)
    seen = np.zeros(views, np.int64)

    def share(first: int, last: int) -> None:
        projection.share(
            means, quaternions, scales, opacities, first, last, settings.alpha_min, stride, shared
        )

    def project(v: int) -> None:
        seen[v] = projection.project(
            plan.views[v], shared, stride, starts[v], plan.counts[v], shifts[v], plan.near, plan.far,
            settings.low_pass, settings.extent, settings.antialiased, tiles_x, records,
            depths, rects, tile_counts[1 + v * tiles : 1 + (v + 1) * tiles],
        )  # fmt: skip

    pool.run([partial(share, *part) for part in _parts(0, len(means))], len(means) // 8)
    pool.run([partial(project, v) for v in range(views)], total)
    tile_starts = np.cumsum(tile_counts)
    entry_starts = np.zeros(total + 1, np.int64)
    np.cumsum((rects[:, 1] - rects[:, 0]) * (rects[:, 3] - rects[:, 2]), out=entry_starts[1:])
    splats, slots = np.empty(tile_starts[-1], np.int32), np.empty(tile_starts[-1], np.int64)

    def scatter(v: int) -> None:
        binning.scatter(
            depths, rects, starts[v], plan.counts[v], seen[v], tiles_x, tile_starts, v * tiles, entry_starts,
            splats, slots,
        )  # fmt: skip

    pool.run([partial(scatter, v) for v in range(views)], len(splats))
    hits = np.empty(len(splats), np.uint16)
    return _Splats(shifts, shared, stride, records, rects, entry_starts, tile_starts, splats, slots, hits)


def _parts(first: int, count: int) -> list[tuple[int, int]]:
    """``count`` things from ``first`` on in a run for each thread, each but the last of whole vectors."""
    step = -(-count // (torch.get_num_threads() * simd.DOUBLES)) * simd.DOUBLES
    return [(a, min(a + step, first + count)) for a in range(first, first + count, max(step, 1))]


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
    def forward(ctx, means, quaternions, scales, opacities, colors, plan: _Plan):
        arrays = [t.detach().numpy() for t in (means, quaternions, scales, opacities, colors)]
        found = _prepare(plan, *arrays[:4])
        channels, size = colors.shape[1], (plan.height, plan.width)
        image, alpha, depth = (_zeros(*plan.shape, planes, *size) for planes in (channels, 1, 1))
        outputs = [_flat(t) for t in (image, alpha, depth)]
        pool.run([
            partial(
                raster.forward, tiles, *plan.tiles, *size, plan.views, found.tile_starts, found.splats,
                found.shifts, found.records, arrays[4], _channels(channels), *plan.constants, found.hits,
                *outputs,
            )
            for tiles in _tile_runs(found.tile_starts)
        ], len(found.splats))  # fmt: skip
        ctx.save_for_backward(means, quaternions, scales, opacities, colors, image, alpha, depth)
        ctx.set_materialize_grads(False)
        ctx.plan, ctx.found = plan, found
        return image, alpha, depth

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, d_image, d_alpha, d_depth):
        *inputs, image, alpha, depth = ctx.saved_tensors
        plan, found, settings = ctx.plan, ctx.found, ctx.plan.settings
        _, quaternions, scales, _, colors = (t.detach().numpy() for t in inputs)
        width = layout.gradient_width(colors.shape[1])
        # PyTorch's memory starts on a cache line, as the kernels need it.
        entries = torch.empty(len(found.splats) * width).numpy()
        d_image = _zeros(*image.shape) if d_image is None else d_image
        arrays = [_flat(t) for t in (image, alpha, depth, d_image, d_alpha, d_depth)]
        pool.run([
            partial(
                raster.backward, tiles, *plan.tiles, plan.height, plan.width, plan.views, found.tile_starts,
                found.splats, found.slots, found.shifts, found.records, colors, _channels(colors.shape[1]),
                *plan.constants, found.hits, *arrays, entries,
            )
            for tiles in _tile_runs(found.tile_starts)
        ], len(found.splats))  # fmt: skip
        results = [_zeros(*t.shape) for t in inputs]
        views_each = plan.shape[1]
        tasks = [
            partial(
                gradients.collect, quaternions, scales, plan.views, first_view, first_view + views_each,
                *part, found.shifts, settings.low_pass, settings.antialiased, found.shared, found.stride,
                found.records, found.rects, found.entry_starts, entries, *(t.numpy() for t in results),
            )
            for first_view in range(0, len(plan.views), max(1, views_each))
            for part in _parts(int(plan.first_gaussians[first_view]), int(plan.counts[first_view]))
        ]  # fmt: skip
        pool.run(tasks, len(found.splats) // 2)
        return *results, None


def _zeros(*shape: int) -> Tensor:
    """Zeros by NumPy: the operating system's own, where PyTorch would wake its threads to write them."""
    return torch.from_numpy(np.zeros(shape, np.float32))


def _flat(tensor: Tensor | None) -> np.ndarray:
    """All numbers of an image in one row; none for an image that is absent."""
    return (
        np.empty(0, np.float32) if tensor is None else tensor.detach().float().contiguous().flatten().numpy()
    )


def _channels(count: int):
    """What tells a kernel the number of channels: a tuple of that length compiles it for them."""
    return (0,) * count if count == _COLORS else count
