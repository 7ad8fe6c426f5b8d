"""Windows of maps, and the windows that the layers of a dense head need for a window of its result."""

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from ghgs_lit.extents import Extent
from ghgs_lit.geometry.projection import at_least_float32
from ghgs_lit.plan.rows import size_class


class Span(NamedTuple):
    """Cells ``start`` to ``stop`` (excluded) of the ``full`` cells of a map along one axis."""

    start: int
    stop: int
    full: int

    def grown(self, cells: int) -> "Span":
        return Span(max(self.start - cells, 0), min(self.stop + cells, self.full), self.full)

    def sources(self, full: int) -> "Span":
        """The cells of a map of ``full`` cells from which these are interpolated."""
        first, last = (cell * (full - 1) // max(self.full - 1, 1) for cell in (self.start, self.stop - 1))
        return Span(first, min(last + 2, full), full)

    def coarser(self, factor: int) -> "Span":
        """The blocks of ``factor`` cells that contain these."""
        return Span(self.start // factor, -(-self.stop // factor), -(-self.full // factor))

    def finer(self, factor: int, full: int) -> "Span":
        """The cells of these blocks of ``factor`` cells; the last block may be smaller."""
        return Span(self.start * factor, min(self.stop * factor, full), full)

    def widened(self) -> "Span":
        """These and more cells, so that their number is a size class."""
        length = min(size_class(self.stop - self.start), self.full)
        start = min(self.start, self.full - length)
        return Span(start, start + length, self.full)

    def hull(self, other: "Span") -> "Span":
        return Span(min(self.start, other.start), max(self.stop, other.stop), self.full)


class Window(NamedTuple):
    """A rectangle of a map: the same part of every image."""

    rows: Span
    columns: Span

    @classmethod
    def whole(cls, size: tuple[int, int]) -> "Window":
        return cls(*(Span(0, full, full) for full in size))

    @property
    def full(self) -> tuple[int, int]:
        """Height and width of the whole map."""
        return self.rows.full, self.columns.full

    @property
    def is_whole(self) -> bool:
        return self == Window.whole(self.full)

    @property
    def slices(self) -> tuple[slice, slice]:
        return slice(*self.rows[:2]), slice(*self.columns[:2])

    def grown(self, cells: int) -> "Window":
        return Window(*(span.grown(cells) for span in self))

    def sources(self, full: tuple[int, int]) -> "Window":
        return Window(*(span.sources(n) for span, n in zip(self, full, strict=True)))

    def coarser(self, factor: int) -> "Window":
        return Window(*(span.coarser(factor) for span in self))

    def finer(self, factor: int, full: tuple[int, int]) -> "Window":
        return Window(*(span.finer(factor, n) for span, n in zip(self, full, strict=True)))

    def hull(self, other: "Window") -> "Window":
        return Window(*(mine.hull(its) for mine, its in zip(self, other, strict=True)))

    def cut(self, maps: Float[Tensor, "n c h w"], inner: "Window") -> Float[Tensor, "n c h2 w2"]:
        """Crop maps of this window to ``inner``."""
        if inner == self:
            return maps
        rows, columns = (
            slice(its.start - mine.start, its.stop - mine.start)
            for mine, its in zip(self, inner, strict=True)
        )
        return maps[..., rows, columns]

    def resize(self, maps: Float[Tensor, "n c h w"], target: "Window") -> Float[Tensor, "n c h2 w2"]:
        """Resize maps of this window to ``target``, a window of maps of another size; bilinear, as
        ``F.interpolate`` with ``align_corners=True`` on the whole maps."""
        if self.full == target.full:
            return self.cut(maps, target)
        if self.is_whole and target.is_whole:
            return F.interpolate(maps, target.full, mode="bilinear", align_corners=True)
        found = at_least_float32(maps).permute(0, 2, 3, 1)  # channels are innermost
        for axis, source, wanted in zip((1, 2), self, target, strict=True):
            found = _interpolate(found, axis, source, wanted)
        return found.permute(0, 3, 1, 2).to(maps.dtype)


def _interpolate(maps: Tensor, axis: int, source: Span, target: Span) -> Tensor:
    """Linear interpolation along one axis, with the weights of ``F.interpolate``."""
    low, high, weight = _sources(source, target, maps.dtype, maps.device)
    weight = weight.view(-1, *[1] * (3 - axis))
    below, above = (maps.index_select(axis, cell) for cell in (low, high))
    return torch.lerp(below, above, weight) if torch.is_grad_enabled() else below.lerp_(above, weight)


@lru_cache(maxsize=1024)  # on a GPU windows begin at patches, so that few differ
@torch.inference_mode(False)  # the cached tensors may be used with a gradient later
def _sources(
    source: Span, target: Span, dtype: torch.dtype, device: torch.device
) -> tuple[Tensor, Tensor, Tensor]:
    """For each cell of the target, the two cells of the source around it, and the weight of the second."""
    numbers, place, low, high, weight = _of_whole_maps(source.full, target.full, dtype, device)
    wanted = slice(target.start, target.stop)
    low = low[wanted]
    high = high[wanted]
    weight = weight[wanted]
    first = numbers[target.start]
    last = min(numbers[target.stop - 1] + 1, source.full - 1)
    if first < source.start or last >= source.stop:  # the window ends before its neighbours do
        low = low.clamp(source.start, source.stop - 1)
        high = (low + 1).clamp(max=source.stop - 1)
        weight = place[wanted] - low
    return (low - source.start, high - source.start, weight) if source.start else (low, high, weight)


@lru_cache(maxsize=256)
@torch.inference_mode(False)  # the cached tensors may be used with a gradient later
def _of_whole_maps(
    source: int, target: int, dtype: torch.dtype, device: torch.device
) -> tuple[list[int], Tensor, Tensor, Tensor, Tensor]:
    """For each of ``target`` cells: its place among ``source`` cells, the two cells around it, the weight of
    the second; the first of the two also as numbers, which are known without waiting for a GPU."""
    # A division and a product, both rounded to the precision of the maps, as in PyTorch.
    step = torch.tensor((source - 1) / max(target - 1, 1), dtype=dtype, device="cpu").item()
    numbers = (torch.arange(target, dtype=dtype, device="cpu") * step).long().tolist()
    place = torch.arange(target, dtype=dtype, device=device) * step
    low = place.long().clamp(max=source - 1)
    return numbers, place, low, (low + 1).clamp(max=source - 1), place - low


def subject_windows(extents: Sequence[Extent], size: tuple[int, int]) -> list[Window | None]:
    """The bounding window of the mask of each image, None if empty. ``size``: height, width of images."""
    height, width = size
    return [
        Window(Span(top, bottom, height), Span(left, right, width)) if count else None
        for count, top, bottom, left, right in extents
    ]


def reach(*modules: nn.Module) -> int:
    """Number of cells on each side that the result of these consecutive layers depends on."""
    layers = (layer for module in modules for layer in module.modules())
    return sum(layer.kernel_size[0] // 2 for layer in layers if isinstance(layer, nn.Conv2d))
