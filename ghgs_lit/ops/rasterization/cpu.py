"""The CPU rasterizer as a differentiable PyTorch function."""

import threading
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from torch import Tensor

from ghgs_lit.errors import require
from ghgs_lit.ops import pool, simd
from ghgs_lit.ops.rasterization import layout, projection
from ghgs_lit.ops.rasterization.backward import backward
from ghgs_lit.ops.rasterization.forward import forward, scatter
from ghgs_lit.ops.rasterization.gradients import collect
from ghgs_lit.ops.rasterization.settings import RasterSettings
from ghgs_lit.types import Cameras, Gaussians, Rendering


@dataclass(frozen=True)
class Plan:
    """Division of the work of a call, independent of the values of the Gaussians.

    View ``v`` belongs to batch element ``v // T``.

    Attributes:
        views: cameras as rows of ``layout.VIEW`` doubles, [B T, VIEW].
        edges: boundaries of the P parts of each element, as indices of Gaussians, [B, P + 1].
        shifts: Gaussian ``n`` is splat ``n + shifts[v]`` of view ``v``, [B T].
        splats: number of splats in all views.
        shape: (B, T).
        height: image height in pixels.
        width: image width in pixels.
        settings: constants of rendering.
        near: smallest rendered depth of a centre, in metres.
        far: largest rendered depth of a centre, in metres.
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
        """Make the plan; it depends on the cameras and on the numbers of Gaussians.

        Args:
            gaussians: N Gaussians of B elements.
            cameras: [B, T].
            settings: constants of rendering.
            near: smallest rendered depth of a centre, in metres.
            far: largest rendered depth of a centre, in metres.
        """
        counts = np.array(gaussians.splits, dtype=np.int64)
        views_each = cameras.shape[1]
        firsts = np.cumsum(counts) - counts
        # Each view has whole vectors of splats, so that no two threads write to the same vector.
        sizes = np.repeat(-(-counts // simd.DOUBLES) * simd.DOUBLES, views_each)
        views = _view_rows(cameras, settings)
        edges = _part_edges(firsts, counts)
        shifts = np.cumsum(sizes) - sizes - np.repeat(firsts, views_each)
        numbers = int(sizes.sum()), tuple(cameras.shape), cameras.height, cameras.width
        return cls(views, edges, shifts, *numbers, settings, near, far)

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
        """Non-empty parts as (batch element, part, first Gaussian, end, views of the element)."""
        views = self.shape[1]
        parts = []
        for b, edges in enumerate(self.edges):
            seen_by = slice(b * views, (b + 1) * views)
            for p in range(len(edges) - 1):
                if edges[p] < edges[p + 1]:
                    parts.append((b, p, int(edges[p]), int(edges[p + 1]), seen_by))
        return parts


def _part_edges(firsts: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Boundaries [B, P + 1] of the parts of each element, of which all but the last are whole vectors,
    from the first Gaussians and the counts of the elements, [B]."""
    threads = torch.get_num_threads()
    total = int(counts.sum())
    parts = 1 if threads == 1 else max(1, min(-(-2 * threads // max(1, len(counts))), total // pool.GRAIN))
    steps = -(-counts // (parts * simd.DOUBLES)) * simd.DOUBLES
    edges = np.minimum(steps[:, None] * np.arange(parts + 1), counts[:, None])
    return edges + firsts[:, None]


def _view_rows(cameras: Cameras, settings: RasterSettings) -> np.ndarray:
    """Cameras as rows of ``layout.VIEW`` doubles, [B T, VIEW]."""
    intrinsics = cameras.intrinsics.detach().double().flatten(0, -3).numpy()
    extrinsics = cameras.extrinsics.detach().double().flatten(0, -3).numpy()
    rows = np.zeros((len(intrinsics), layout.VIEW))
    sides = ((0, cameras.width, layout.X_LOW), (1, cameras.height, layout.Y_LOW))
    for axis, size, low in sides:
        focal = intrinsics[:, axis, axis]
        center = intrinsics[:, axis, 2]
        margin = settings.frustum_margin * 0.5 * size / focal
        rows[:, layout.FX + axis] = focal
        rows[:, layout.CX + axis] = center
        rows[:, low] = -center / focal - margin
        rows[:, low + 1] = (size - center) / focal + margin
    rows[:, layout.RIGHT] = cameras.width - 1
    rows[:, layout.BOTTOM] = cameras.height - 1
    rows[:, layout.ROTATION : layout.ROTATION + 9] = extrinsics[:, :3, :3].reshape(-1, 9)
    rows[:, layout.TRANSLATION : layout.TRANSLATION + 3] = extrinsics[:, :3, 3]
    return rows


# Runs of tiles per thread: several short runs balance the load of the threads.
_RUNS = 8
# Kernels are specialised for this number of channels, and compiled once for all others.
_COLORS = 3
# Limit in bytes of the tile lists and their gradients: a splat that fills the frame is in every list.
_MEMORY = 1 << 32


def rasterize(
    gaussians: Gaussians, cameras: Cameras, settings: RasterSettings, near: float, far: float
) -> Rendering:
    """Render on black in float32; see :func:`ghgs_lit.rendering.render`.

    Differentiable with respect to the Gaussians, not the cameras. The result is bitwise the same for
    any number of threads.

    Args:
        gaussians: Gaussians of B elements, on a CPU, in metres.
        cameras: [B, T], in metres.
        settings: constants of rendering.
        near: smallest rendered depth of a centre, in metres.
        far: largest rendered depth of a centre, in metres.

    Returns:
        Image [B, T, C, h, w], alpha and expected depth [B, T, 1, h, w].

    Raises:
        InputError: the tile lists would exceed 4 GiB (``_MEMORY``).
    """
    fields = (gaussians.means, gaussians.quaternions, gaussians.scales, gaussians.opacities, gaussians.colors)
    plan = Plan.of(gaussians, cameras, settings, near, far)
    return Rendering(*_Rasterize.apply(*(field.float().contiguous() for field in fields), plan))


@dataclass
class _Splats:
    """Splats of all views and entries of all tiles; see ``layout``.

    Attributes:
        records: [splats, RECORD], float32.
        boxes: tiles that a splat touches, [splats, 4], int32.
        entry_starts: first slot of each splat, [splats], int32.
        tile_starts: first entry of each tile of each view, [B T tiles + 1], int64.
        entries: [entries, ENTRY], int32.
        drawn: number of rendered entries of each tile, [B T tiles], int64.
        reached: whether an entry was rendered, by slot, [entries], uint8.
    """

    records: np.ndarray
    boxes: np.ndarray
    entry_starts: np.ndarray
    tile_starts: np.ndarray
    entries: np.ndarray
    drawn: np.ndarray
    reached: np.ndarray


def _prepare(plan: Plan, means, quaternions, scales, opacities, colors, differentiable: bool) -> _Splats:
    """Project all Gaussians into their views and list the splats of each tile.

    Args:
        plan: division of the work.
        means: in metres, float32 [N, 3].
        quaternions: wxyz of any length, float32 [N, 4].
        scales: standard deviations in metres, float32 [N, 3].
        opacities: float32 [N, 1].
        colors: float32 [N, C].
        differentiable: count the memory of the gradients as well.

    Raises:
        InputError: the lists and, if ``differentiable``, their gradients would exceed ``_MEMORY``.
    """
    settings = plan.settings
    tiles_x, tiles_y = plan.tiles
    total = plan.splats
    elements, views = plan.shape
    parts = plan.parts
    records = simd.aligned_floats(total * layout.RECORD).reshape(total, layout.RECORD)
    depths = np.empty((total, 1), np.float32)
    boxes = np.empty((total, 4), np.int32)
    counts = np.zeros((elements, plan.edges.shape[1] - 1, views, tiles_x * tiles_y), np.int64)
    pool.run([
        partial(
            projection.project, means, quaternions, scales, opacities, colors, first, last,
            plan.views[seen_by], plan.shifts[seen_by], plan.near, plan.far, settings.low_pass,
            settings.extent, settings.alpha_min, settings.antialiased, tiles_x, records, depths, boxes,
            counts[b, p],
        )
        for b, p, first, last, seen_by in parts
    ], total)  # fmt: skip
    tile_starts = np.concatenate(([0], counts.sum(1).reshape(-1).cumsum()))
    of_parts = counts.sum((2, 3))
    slots = np.cumsum(of_parts).reshape(of_parts.shape) - of_parts
    size = int(tile_starts[-1])
    each = 4 * (layout.ENTRY + (layout.gradient_width(colors.shape[1]) if differentiable else 0))
    require(
        size * each <= _MEMORY,
        "renderer.backend=cpu",
        f"lists of tiles of {_MEMORY / 2**30:g} GiB at most (smaller splats, fewer or smaller views)",
        f"{size * each / 2**30:.1f} GiB: {size} entries, {size // max(len(means), 1)} of each Gaussian",
    )
    next_free = tile_starts[:-1].reshape(elements, 1, *counts.shape[2:]) + np.cumsum(counts, 1) - counts
    entries = np.empty((size, layout.ENTRY), np.int32)
    entry_starts = np.empty(total, np.int32)
    pool.run([
        partial(
            scatter, first, last, plan.shifts[seen_by], depths, boxes, tiles_x, slots[b, p], entry_starts,
            next_free[b, p], entries,
        )
        for b, p, first, last, seen_by in parts
    ], size)  # fmt: skip
    drawn = np.zeros(len(tile_starts) - 1, np.int64)
    reached = np.zeros(size, np.uint8)
    return _Splats(records, boxes, entry_starts, tile_starts, entries, drawn, reached)


def _tile_runs(tile_starts: np.ndarray) -> list[np.ndarray]:
    """Divide the tiles that have entries into runs of about equal work."""
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
    def forward(ctx, means, quaternions, scales, opacities, colors, plan: Plan):
        """Render all views.

        Args:
            ctx: context of autograd.
            means: in metres, float32 [N, 3]; contiguous, as are all tensors here.
            quaternions: wxyz of any length, float32 [N, 4].
            scales: standard deviations in metres, float32 [N, 3].
            opacities: float32 [N].
            colors: float32 [N, C].
            plan: division of the work.

        Returns:
            Image [B, T, C, h, w], alpha and expected depth [B, T, 1, h, w].
        """
        arrays = [t.detach().numpy() for t in (means, quaternions, scales, opacities[:, None], colors)]
        splats = _prepare(plan, *arrays, differentiable=any(ctx.needs_input_grad))
        channels = colors.shape[1]
        size = (plan.height, plan.width)
        image = _zeros(*plan.shape, channels, *size)
        alpha = _zeros(*plan.shape, 1, *size)
        depth = _zeros(*plan.shape, 1, *size)
        outputs = [_flat(t) for t in (image, alpha, depth)]
        pool.run([
            partial(
                forward, tiles, *plan.tiles, *size, plan.views, splats.tile_starts, splats.entries,
                plan.shifts, splats.records, arrays[4], _channels(channels), *plan.constants, splats.drawn,
                splats.reached, *outputs,
            )
            for tiles in _tile_runs(splats.tile_starts)
        ], len(splats.entries))  # fmt: skip
        ctx.save_for_backward(means, quaternions, scales, opacities, colors, image, alpha, depth)
        ctx.set_materialize_grads(False)
        ctx.plan = plan
        ctx.splats = splats
        return image, alpha, depth

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, d_image, d_alpha, d_depth):
        """Compute the gradients of the five inputs.

        Args:
            ctx: context of autograd.
            d_image: gradient of the image, [B, T, C, h, w]; None: 0.
            d_alpha: gradient of alpha, [B, T, 1, h, w]; None: 0.
            d_depth: gradient of the depth, [B, T, 1, h, w]; None: 0.

        Returns:
            Gradients in the shapes of the inputs, and None for the plan.
        """
        *inputs, image, alpha, depth = ctx.saved_tensors
        plan = ctx.plan
        splats = ctx.splats
        settings = ctx.plan.settings
        means, quaternions, scales, _, colors = (t.detach().numpy() for t in inputs)
        gradients = _scratch(len(splats.entries) * layout.gradient_width(colors.shape[1]))
        d_image = _zeros(*image.shape) if d_image is None else d_image
        images = [_flat(t) for t in (image, alpha, depth, d_image, d_alpha, d_depth)]
        pool.run([
            partial(
                backward, tiles, *plan.tiles, plan.height, plan.width, plan.views, splats.tile_starts,
                splats.entries, plan.shifts, splats.records, colors, _channels(colors.shape[1]),
                *plan.constants, splats.drawn, *images, gradients,
            )
            for tiles in _tile_runs(splats.tile_starts)
        ], len(splats.entries))  # fmt: skip
        results = [torch.empty_like(t) for t in inputs]
        d_means, d_quaternions, d_scales, d_opacities, d_colors = (t.numpy() for t in results)
        pool.run([
            partial(
                collect, means, quaternions, scales, first, last, plan.views[seen_by], plan.shifts[seen_by],
                settings.low_pass, settings.antialiased, splats.records, splats.boxes, splats.entry_starts,
                splats.reached, gradients, d_means, d_quaternions, d_scales, d_opacities[:, None], d_colors,
            )
            for _, _, first, last, seen_by in plan.parts
        ], len(splats.entries) // 2)  # fmt: skip
        return *results, None


_kept = threading.local()
# Floats of scratch memory that a thread may keep, since allocating takes longer than filling.
_KEEP = 1 << 24


def _scratch(count: int) -> np.ndarray:
    """Aligned scratch floats, valid until the next call on this thread."""
    buffer = getattr(_kept, "buffer", None)
    if buffer is None or len(buffer) < count:
        buffer = simd.aligned_floats(count + count // 4)
        _kept.buffer = buffer if len(buffer) <= _KEEP else None
    return buffer[:count]


def _zeros(*shape: int) -> Tensor:
    """Zeros from NumPy, in memory zeroed by the system: PyTorch would start threads to write them."""
    return torch.from_numpy(np.zeros(shape, np.float32))


def _flat(tensor: Tensor | None) -> np.ndarray:
    if tensor is None:
        return np.empty(0, np.float32)
    return tensor.detach().float().contiguous().flatten().numpy()


def _channels(count: int):
    """The number of channels as kernels take it: a tuple of that length is a compile-time constant."""
    return (0,) * count if count == _COLORS else count
