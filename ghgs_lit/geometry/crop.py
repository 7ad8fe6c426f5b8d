"""Frames that the stages see in place of the photographs: padded to whole patches, or cut to the subject.

A photograph whose sides are no multiples of the patch size gets a black border (:class:`Padding`); most
of a photograph is background that no Gaussian comes from (:class:`Windows`). What the stages predict
comes back in the photograph's own pixels.
"""

import dataclasses
from abc import ABC, abstractmethod
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Int
from torch import Tensor

from ghgs_lit.bounds.visual_hull import Interval
from ghgs_lit.types import Batch, Points, Prediction


class Frame(ABC):
    """Pictures of ``height`` x ``width`` whose first pixel is pixel (``top``, ``left``) of photographs of
    ``full`` (height, width); both may be negative."""

    top: Int[Tensor, "B V"] | int
    left: Int[Tensor, "B V"] | int
    height: int
    width: int
    full: tuple[int, int]

    @abstractmethod
    def cut(self, maps: Tensor, fill: float | bool = 0) -> Tensor:
        """Maps ``[B, V, H, W, ...]`` of the photographs as maps of the frame, ``fill`` where it is larger."""

    @abstractmethod
    def paste(self, maps: Tensor, fill: float | bool) -> Tensor:
        """Maps of the frame as maps of the photographs, ``fill`` where the frame is smaller."""

    def cut_interval(self, interval: Interval | None) -> Interval | None:
        """Bounds of depth; outside of the photographs they mean nothing, but they are depths."""
        return None if interval is None else (self.cut(interval[0], 1.0), self.cut(interval[1], 1.0))

    def cut_batch(self, batch: Batch) -> Batch:
        """The batch as if every input had been photographed through the frame; targets stay."""
        intrinsics = batch.cameras.intrinsics.clone()
        intrinsics[..., 0, 2] -= self.left
        intrinsics[..., 1, 2] -= self.top
        cameras = dataclasses.replace(
            batch.cameras, intrinsics=intrinsics, height=self.height, width=self.width
        )
        return dataclasses.replace(
            batch,
            images=self.cut(batch.images.movedim(2, -1)).movedim(-1, 2),
            masks=self.cut(batch.masks, False),
            depths=None if batch.depths is None else self.cut(batch.depths),
            cameras=cameras,
        )

    def paste_prediction(self, prediction: Prediction) -> Prediction:
        """The prediction of a cut batch on the photographs; outside the frame nothing is valid."""
        maps = prediction.depth_maps
        whole = dataclasses.replace(
            maps,
            depth=self.paste(maps.depth, 1.0),
            valid=self.paste(maps.valid, False),
            confidence=self.paste(maps.confidence, 1.0),
            near=None if maps.near is None else self.paste(maps.near, 1.0),
            far=None if maps.far is None else self.paste(maps.far, 1.0),
        )
        gaussians = prediction.gaussians
        top, left = (
            start if isinstance(start, int) else start.flatten()[gaussians.image]
            for start in (self.top, self.left)
        )
        row, column = gaussians.pixel // self.width + top, gaussians.pixel % self.width + left
        return Prediction(
            gaussians=dataclasses.replace(gaussians, pixel=row * self.full[1] + column),
            depth=whole.depth,
            depth_valid=whole.valid,
            points=Points(
                pixels=self.paste(prediction.points.pixels, 0.0),
                valid=whole.valid,
                tokens=prediction.points.tokens,
                tokens_valid=prediction.points.tokens_valid,
            ),
            depth_maps=whole,
        )


@dataclass(frozen=True)
class Padding(Frame):
    """The photographs in the middle of a larger frame: ``top`` and ``left`` are 0 or negative."""

    top: int
    left: int
    height: int
    width: int
    full: tuple[int, int]

    def cut(self, maps: Tensor, fill: float | bool = 0) -> Tensor:
        return F.pad(maps, self._sides(maps), value=fill)

    def paste(self, maps: Tensor, fill: float | bool) -> Tensor:
        return F.pad(maps, [-side for side in self._sides(maps)])

    def _sides(self, maps: Tensor) -> list[int]:
        """The widths of the border in the order of ``F.pad``: last axis first, each before and after."""
        below, right = self.height - self.full[0] + self.top, self.width - self.full[1] + self.left
        return [0, 0] * (maps.dim() - 4) + [-self.left, right, -self.top, below]


@dataclass(frozen=True)
class Windows(Frame):
    """One window for each view, all ``height`` x ``width``, inside the photographs."""

    top: Int[Tensor, "B V"]
    left: Int[Tensor, "B V"]
    height: int
    width: int
    full: tuple[int, int]

    def cut(self, maps: Tensor, fill: float | bool = 0) -> Tensor:
        return maps[self._index()]

    def paste(self, maps: Tensor, fill: float | bool) -> Tensor:
        whole = maps.new_full((*self.top.shape, *self.full, *maps.shape[4:]), fill)
        return whole.index_put(self._index(), maps)

    def _index(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Indices that pick the windows out of maps ``[B, V, H, W, ...]``."""
        b, v = self.top.shape
        device = self.top.device
        element = torch.arange(b, device=device)[:, None, None, None]
        view = torch.arange(v, device=device)[:, None, None]
        rows = self.top[..., None, None] + torch.arange(self.height, device=device)[:, None]
        columns = self.left[..., None, None] + torch.arange(self.width, device=device)
        return element, view, rows, columns


def patch_padding(masks: Bool[Tensor, "B V H W"], multiple: int) -> Padding | None:
    """The smallest border that makes both sides multiples; an odd pixel goes below and to the right.

    512 becomes 518 with 3 pixels on each side, as in the authors' release. None where nothing is missing.
    """
    height, width = masks.shape[2:]
    missing = (-height % multiple, -width % multiple)
    if missing == (0, 0):
        return None
    sides = (height + missing[0], width + missing[1])
    return Padding(-(missing[0] // 2), -(missing[1] // 2), *sides, full=(height, width))


def subject_windows(masks: Bool[Tensor, "B V H W"], multiple: int, margin: int = 2) -> Windows:
    """Windows that hold every view's mask with ``margin`` pixels around it, where the image has them.

    One size serves the whole batch: that of the largest mask, rounded up to ``multiple`` (the patch
    size, which divides the image). A view with an empty mask gets the middle of its image.
    """
    starts, sizes = [], []
    for axis in (2, 3):
        length = masks.shape[axis]
        hit = masks.any(5 - axis)
        index = torch.arange(length, device=masks.device).expand_as(hit)
        first = torch.where(hit, index, length).amin(-1)
        last = torch.where(hit, index, -1).amax(-1)
        first, last = (torch.where(last < 0, length // 2, end) for end in (first, last))
        needed = int((last - first).max()) + 1 + 2 * margin
        size = min(-(-needed // multiple) * multiple, length)
        sizes.append(size)
        # Integer division keeps the middle; the clamp keeps the window inside the image.
        starts.append(((first + last + 1 - size) // 2).clamp(0, length - size))
    return Windows(*starts, *sizes, full=tuple(masks.shape[2:]))
