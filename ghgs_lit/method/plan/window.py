"""Windows of maps, and the windows that layers of a dense head need for a window of its output."""

import itertools
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from ghgs_lit.extents import Extent, bucket_size
from ghgs_lit.geometry.projection import at_least_float32


class Span(NamedTuple):
    """Cells ``start`` to ``stop`` (excluded) of the ``full`` cells of a map along one axis."""

    start: int
    stop: int
    full: int

    def grow(self, cells: int) -> "Span":
        """The span enlarged by ``cells`` on each side, clipped to the map."""
        return Span(max(self.start - cells, 0), min(self.stop + cells, self.full), self.full)

    def sources(self, full: int) -> "Span":
        """Cells of a map of ``full`` cells from which this span is interpolated."""
        first, last = (cell * (full - 1) // max(self.full - 1, 1) for cell in (self.start, self.stop - 1))
        return Span(first, min(last + 2, full), full)

    def coarser(self, factor: int) -> "Span":
        """Blocks of ``factor`` cells that contain this span."""
        return Span(self.start // factor, -(-self.stop // factor), -(-self.full // factor))

    def finer(self, factor: int, full: int) -> "Span":
        """Cells of these blocks of ``factor`` cells; the last block may be smaller."""
        return Span(self.start * factor, min(self.stop * factor, full), full)

    def widen(self) -> "Span":
        """The span enlarged to a length of :func:`ghgs_lit.extents.bucket_size`, within the map."""
        length = min(bucket_size(self.stop - self.start), self.full)
        start = min(self.start, self.full - length)
        return Span(start, start + length, self.full)

    def hull(self, other: "Span") -> "Span":
        """Smallest span of the same map that contains both."""
        return Span(min(self.start, other.start), max(self.stop, other.stop), self.full)


class Window(NamedTuple):
    """A rectangle of maps, the same in every image."""

    rows: Span
    columns: Span

    @classmethod
    def whole(cls, size: tuple[int, int]) -> "Window":
        """The whole map of ``size`` (height, width)."""
        return cls(*(Span(0, full, full) for full in size))

    @property
    def full(self) -> tuple[int, int]:
        """Height and width of the whole map."""
        return self.rows.full, self.columns.full

    @property
    def is_whole(self) -> bool:
        """Whether the window is the whole map."""
        return self == Window.whole(self.full)

    @property
    def slices(self) -> tuple[slice, slice]:
        """Rows and columns as slices, to index maps."""
        return slice(*self.rows[:2]), slice(*self.columns[:2])

    def grow(self, cells: int) -> "Window":
        """Apply :meth:`Span.grow` along both axes; the next four methods do likewise."""
        return Window(*(span.grow(cells) for span in self))

    def sources(self, full: tuple[int, int]) -> "Window":
        return Window(*(span.sources(n) for span, n in zip(self, full, strict=True)))

    def coarser(self, factor: int) -> "Window":
        return Window(*(span.coarser(factor) for span in self))

    def finer(self, factor: int, full: tuple[int, int]) -> "Window":
        return Window(*(span.finer(factor, n) for span, n in zip(self, full, strict=True)))

    def hull(self, other: "Window") -> "Window":
        return Window(*(mine.hull(its) for mine, its in zip(self, other, strict=True)))

    def cut(self, maps: Float[Tensor, "n c h w"], inner: "Window") -> Float[Tensor, "n c h2 w2"]:
        """Crop maps of this window to a window ``inner`` within it."""
        if inner == self:
            return maps
        rows, columns = (
            slice(its.start - mine.start, its.stop - mine.start)
            for mine, its in zip(self, inner, strict=True)
        )
        return maps[..., rows, columns]

    def resize(self, maps: Float[Tensor, "n c h w"], target: "Window") -> Float[Tensor, "n c h2 w2"]:
        """Resize maps of this window bilinearly, with the weights of ``F.interpolate`` with
        ``align_corners=True`` on whole maps.

        Args:
            maps: maps of this window.
            target: window of maps of another size, or of the same.
        """
        if self.full == target.full:
            return self.cut(maps, target)
        if self.is_whole and target.is_whole:
            return F.interpolate(maps, target.full, mode="bilinear", align_corners=True)
        resized = at_least_float32(maps).permute(0, 2, 3, 1)  # channels are innermost in memory
        for axis, source, wanted in zip((1, 2), self, target, strict=True):
            resized = _interpolate(resized, axis, source, wanted)
        return resized.permute(0, 3, 1, 2).to(maps.dtype)


def _interpolate(maps: Tensor, axis: int, source: Span, target: Span) -> Tensor:
    """Interpolate maps [n, h, w, c] linearly along axis 1 or 2, with the weights of ``F.interpolate``."""
    low, high, weight = _sources(source, target, maps.dtype, maps.device)
    weight = weight.view(-1, *[1] * (3 - axis))
    below, above = (maps.index_select(axis, cell) for cell in (low, high))
    return torch.lerp(below, above, weight) if torch.is_grad_enabled() else below.lerp_(above, weight)


@lru_cache(maxsize=1024)  # on a GPU windows start at patches, so there are few different ones
@torch.inference_mode(False)  # a later use may need gradients
def _sources(
    source: Span, target: Span, dtype: torch.dtype, device: torch.device
) -> tuple[Tensor, Tensor, Tensor]:
    """Indices within ``source`` of the two cells that each target cell lies between, and the weight of
    the second."""
    numbers, place, low, high, weight = _of_whole_maps(source.full, target.full, dtype, device)
    wanted = slice(target.start, target.stop)
    low = low[wanted]
    high = high[wanted]
    weight = weight[wanted]
    first = numbers[target.start]
    last = min(numbers[target.stop - 1] + 1, source.full - 1)
    if first < source.start or last >= source.stop:  # neighbours lie outside the window
        low = low.clamp(source.start, source.stop - 1)
        high = (low + 1).clamp(max=source.stop - 1)
        weight = place[wanted] - low
    return (low - source.start, high - source.start, weight) if source.start else (low, high, weight)


@lru_cache(maxsize=256)
@torch.inference_mode(False)  # a later use may need gradients
def _of_whole_maps(
    source: int, target: int, dtype: torch.dtype, device: torch.device
) -> tuple[list[int], Tensor, Tensor, Tensor, Tensor]:
    """:func:`_sources` of whole maps with ``source`` and ``target`` cells.

    Returns for each target cell: the first source cell (as a list on the host), its position, the first
    and the second source cell, and the weight of the second."""
    # Division and product are both rounded to the dtype of the maps, as in PyTorch.
    step = torch.tensor((source - 1) / max(target - 1, 1), dtype=dtype, device="cpu").item()
    numbers = (torch.arange(target, dtype=dtype, device="cpu") * step).long().tolist()
    place = torch.arange(target, dtype=dtype, device=device) * step
    low = place.long().clamp(max=source - 1)
    return numbers, place, low, (low + 1).clamp(max=source - 1), place - low


def subject_windows(extents: Sequence[Extent], size: tuple[int, int]) -> list[Window | None]:
    """Bounding window of the mask of each image, None if it is empty; ``size`` is height and width."""
    height, width = size
    return [
        Window(Span(top, bottom, height), Span(left, right, width)) if count else None
        for count, top, bottom, left, right in extents
    ]


def reach(*modules: nn.Module) -> int:
    """Radius in cells of the receptive field of consecutive layers."""
    layers = itertools.chain.from_iterable(module.modules() for module in modules)
    return sum(layer.kernel_size[0] // 2 for layer in layers if isinstance(layer, nn.Conv2d))
