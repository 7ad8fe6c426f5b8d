"""The CPU rasterizer as a differentiable PyTorch function."""

import threading
from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

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


class _Part(NamedTuple):
    """Gaussians of an element that one task processes, with the cameras that see them."""

    place: tuple[int, int]
    """Batch element, and index of the part in it."""
    first: int
    last: int
    """End of the Gaussians, excluded."""
    views: np.ndarray
    """Cameras as rows of ``layout.VIEW`` doubles, [T, VIEW]."""
    shifts: np.ndarray
    """Gaussian ``n`` is splat ``n + shifts[t]`` of camera ``t``, [T]."""


def _divide(splits: Sequence[int], views: np.ndarray) -> tuple[list[_Part], int, int]:
    """Divide the Gaussians of each element into parts of whole vectors (all but the last).

    Args:
        splits: number of Gaussians of each element.
        views: cameras [B, T, VIEW].

    Returns:
        Parts, largest number of parts of an element, and number of splats in all views.
    """
    counts = np.array(splits, dtype=np.int64)
    firsts = np.cumsum(counts) - counts
    # Each view has whole vectors of splats, so that no two threads write to the same vector.
    sizes = np.repeat(-(-counts // simd.DOUBLES) * simd.DOUBLES, views.shape[1])
    shifts = (np.cumsum(sizes) - sizes).reshape(views.shape[:2]) - firsts[:, None]
    threads = torch.get_num_threads()
    total = int(counts.sum())
    each = 1 if threads == 1 else max(1, min(-(-2 * threads // max(1, len(counts))), total // pool.GRAIN))
    parts = []
    for b, (first, count) in enumerate(zip(firsts.tolist(), counts.tolist(), strict=True)):
        step = -(-count // (each * simd.DOUBLES)) * simd.DOUBLES
        for p, begin in enumerate(range(0, count, step or 1)):
            end = min(begin + step, count)
            parts.append(_Part((b, p), first + begin, first + end, views[b], shifts[b]))
    return parts, each, int(sizes.sum())


def _view_rows(cameras: Cameras) -> np.ndarray:
    """Cameras as rows of ``layout.VIEW`` doubles, [B T, VIEW]."""
    intrinsics = cameras.intrinsics.detach().double().flatten(0, -3).numpy()
    extrinsics = cameras.extrinsics.detach().double().flatten(0, -3).numpy()
    rows = np.zeros((len(intrinsics), layout.VIEW))
    sides = ((0, cameras.width, layout.X_LOW), (1, cameras.height, layout.Y_LOW))
    for axis, size, low in sides:
        focal = intrinsics[:, axis, axis]
        center = intrinsics[:, axis, 2]
        margin = layout.FRUSTUM_MARGIN * 0.5 * size / focal
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
# Limit in bytes of the tile lists and their gradients: a splat that fills the frame is in every list.
_MEMORY = 1 << 32


def rasterize(gaussians: Gaussians, cameras: Cameras, settings: RasterSettings, near: float) -> Rendering:
    """Render on black in float32; see :func:`ghgs_lit.rendering.render`.

    Differentiable with respect to the Gaussians, not the cameras. The result is bitwise the same for
    any number of threads.

    Args:
        gaussians: Gaussians of B elements, on a CPU, in metres.
        cameras: [B, T], in metres.
        settings: constants of rendering.
        near: smallest rendered depth of a centre, in metres.

    Returns:
        Image [B, T, 3, h, w], alpha and expected depth [B, T, 1, h, w].

    Raises:
        InputError: the tile lists would exceed 4 GiB (``_MEMORY``).
    """
    fields = (gaussians.means, gaussians.quaternions, gaussians.scales, gaussians.opacities, gaussians.colors)
    fields = [field.float().contiguous() for field in fields]
    return Rendering(*_Rasterize.apply(*fields, gaussians.splits, cameras, settings, near))


class _Splats(NamedTuple):
    """Splats of all views and entries of all tiles; see ``layout``."""

    records: np.ndarray
    """[splats, RECORD], float32."""
    boxes: np.ndarray
    """Tiles that a splat touches, [splats, 4], int32."""
    entry_starts: np.ndarray
    """First slot of each splat, [splats], int32."""
    tile_starts: np.ndarray
    """First entry of each tile of each view, [B T tiles + 1], int64."""
    entries: np.ndarray
    """[entries, ENTRY], int32."""


def _list_splats(
    arrays: Sequence[np.ndarray],
    views: np.ndarray,
    parts: list[_Part],
    shape: tuple[int, int],
    total: int,
    tiles: tuple[int, int],
    options: tuple[float, bool, float],
    differentiable: bool,
) -> _Splats:
    """Project all Gaussians into their views and list the splats of each tile.

    Args:
        arrays: means, quaternions, scales, opacities [N, 1] and colours, float32.
        views: cameras [B T, VIEW].
        parts: division of the work.
        shape: number of elements, and largest number of parts of an element.
        total: number of splats in all views.
        tiles: number of tiles across and down a view.
        options: added variance in px^2, whether opacity is scaled by the determinants, and ``near``.
        differentiable: count the memory of the gradients as well.

    Raises:
        InputError: the lists and, if ``differentiable``, their gradients would exceed ``_MEMORY``.
    """
    records = simd.aligned_floats(total * layout.RECORD).reshape(total, layout.RECORD)
    depths = np.empty((total, 1), np.float32)
    boxes = np.empty((total, 4), np.int32)
    counts = np.zeros((*shape, len(views) // max(1, shape[0]), tiles[0] * tiles[1]), np.int64)
    pool.run([
        partial(
            projection.project, *arrays, *part[1:], *options, tiles[0], records, depths, boxes,
            counts[part.place],
        )
        for part in parts
    ], total)  # fmt: skip
    tile_starts = np.concatenate(([0], counts.sum(1).reshape(-1).cumsum()))
    of_parts = counts.sum((2, 3))
    slots = np.cumsum(of_parts).reshape(shape) - of_parts
    size = int(tile_starts[-1])
    each = 4 * (layout.ENTRY + (layout.GRADIENT if differentiable else 0))
    require(
        size * each <= _MEMORY,
        "renderer.backend=cpu",
        f"lists of tiles of {_MEMORY / 2**30:g} GiB at most (smaller splats, fewer or smaller views)",
        f"{size * each / 2**30:.1f} GiB: {size} entries, {size // max(len(arrays[0]), 1)} of each Gaussian",
    )
    next_free = tile_starts[:-1].reshape(shape[0], 1, *counts.shape[2:]) + np.cumsum(counts, 1) - counts
    entries = np.empty((size, layout.ENTRY), np.int32)
    entry_starts = np.empty(total, np.int32)
    pool.run([
        partial(
            scatter, part.first, part.last, part.shifts, depths, boxes, tiles[0], slots[part.place],
            entry_starts, next_free[part.place], entries,
        )
        for part in parts
    ], size)  # fmt: skip
    return _Splats(records, boxes, entry_starts, tile_starts, entries)


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
    def forward(
        ctx, means, quaternions, scales, opacities, colors, splits, cameras, settings: RasterSettings, near
    ):
        """Render all views.

        Args:
            ctx: context of autograd.
            means: in metres, float32 [N, 3]; contiguous, as are all tensors here.
            quaternions: wxyz of any length, float32 [N, 4].
            scales: standard deviations in metres, float32 [N, 3].
            opacities: float32 [N].
            colors: float32 [N, 3].
            splits: number of Gaussians of each element.
            cameras: [B, T].
            settings: constants of rendering.
            near: smallest rendered depth of a centre, in metres.

        Returns:
            Image [B, T, 3, h, w], alpha and expected depth [B, T, 1, h, w].
        """
        arrays = [t.detach().numpy() for t in (means, quaternions, scales, opacities[:, None], colors)]
        size = (cameras.height, cameras.width)
        tiles = (-(-cameras.width // layout.TILE), -(-cameras.height // layout.TILE))
        views = _view_rows(cameras)
        ctx.parts, each, total = _divide(splits, views.reshape(*cameras.shape, layout.VIEW))
        ctx.options = (settings.low_pass, settings.antialiased)
        shape = (len(splits), each)
        given = (views, ctx.parts, shape, total, tiles, (*ctx.options, near))
        ctx.splats = _list_splats(arrays, *given, differentiable=any(ctx.needs_input_grad))
        records, _, _, tile_starts, entries = ctx.splats
        drawn = np.zeros(len(tile_starts) - 1, np.int64)
        ctx.reached = np.zeros(len(entries), np.uint8)
        outputs = [_zeros(*cameras.shape, channels, *size) for channels in (layout.CHANNELS, 1, 1)]
        # Arguments of both kernels.
        ctx.tiles = (
            *tiles, *size, views, tile_starts, entries, records, np.float32(settings.alpha_max), drawn
        )  # fmt: skip
        images = [_flat(t) for t in outputs]
        runs = _tile_runs(tile_starts)
        pool.run([partial(forward, run, *ctx.tiles, ctx.reached, *images) for run in runs], len(entries))
        ctx.save_for_backward(means, quaternions, scales, opacities, colors, *outputs)
        ctx.set_materialize_grads(False)
        return tuple(outputs)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, d_image, d_alpha, d_depth):
        """Compute the gradients of the five inputs.

        Args:
            ctx: context of autograd.
            d_image: gradient of the image, [B, T, 3, h, w]; None: 0.
            d_alpha: gradient of alpha, [B, T, 1, h, w]; None: 0.
            d_depth: gradient of the depth, [B, T, 1, h, w]; None: 0.

        Returns:
            Gradients in the shapes of the tensors, and None for the other inputs.
        """
        *inputs, image, alpha, depth = ctx.saved_tensors
        records, boxes, entry_starts, tile_starts, entries = ctx.splats
        gradients = _scratch(len(entries) * layout.GRADIENT)
        d_image = _zeros(*image.shape) if d_image is None else d_image
        images = [_flat(t) for t in (image, alpha, depth, d_image, d_alpha, d_depth)]
        runs = _tile_runs(tile_starts)
        pool.run([partial(backward, run, *ctx.tiles, *images, gradients) for run in runs], len(entries))
        means, quaternions, scales = (t.detach().numpy() for t in inputs[:3])
        results = [torch.empty_like(t) for t in inputs]
        d_means, d_quaternions, d_scales, d_opacities, d_colors = (t.numpy() for t in results)
        pool.run([
            partial(
                collect, means, quaternions, scales, *part[1:], *ctx.options, records, boxes, entry_starts,
                ctx.reached, gradients, d_means, d_quaternions, d_scales, d_opacities[:, None], d_colors,
            )
            for part in ctx.parts
        ], len(entries) // 2)  # fmt: skip
        return *results, None, None, None, None


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
