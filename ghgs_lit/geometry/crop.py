"""Crops of the photographs that the stages see: padded to whole patches, or cut to the subject.

A photograph whose sides are not multiples of the patch size gets a black border (:class:`PaddedCrop`); most
of a photograph is background that no Gaussian comes from (:class:`SubjectCrop`). Predictions are pasted
back, so that results are in the photograph's own pixels.
"""

import dataclasses
from abc import ABC, abstractmethod
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Int
from torch import Tensor

from ghgs_lit.geometry.masks import first_and_last
from ghgs_lit.types import Batch, DepthBounds, Prediction


class Crop(ABC):
    """Images of ``height`` x ``width`` whose first pixel is pixel (``top``, ``left``) of photographs of size
    ``full`` (height, width); both may be negative."""

    top: Int[Tensor, "B V"] | int
    left: Int[Tensor, "B V"] | int
    height: int
    width: int
    full: tuple[int, int]

    @abstractmethod
    def cut(self, maps: Tensor, fill: float | bool = 0) -> Tensor:
        """Maps of the photographs [B, V, H, W, ...] as maps of the crop, ``fill`` where it is larger."""

    @abstractmethod
    def paste(self, maps: Tensor, fill: float | bool) -> Tensor:
        """Maps of the crop as maps of the photographs, ``fill`` where the crop is smaller."""

    def cut_bounds(self, bounds: DepthBounds | None) -> DepthBounds | None:
        """Bounds of the crop; outside the photographs they are depths without a meaning."""
        return None if bounds is None else DepthBounds(self.cut(bounds.near, 1.0), self.cut(bounds.far, 1.0))

    def cut_batch(self, batch: Batch) -> Batch:
        """The batch as if every input had been photographed as the crop; targets stay."""
        return dataclasses.replace(
            batch,
            images=self.cut(batch.images.movedim(2, -1)).movedim(-1, 2),
            masks=self.cut(batch.masks, False),
            depths=None if batch.depths is None else self.cut(batch.depths),
            cameras=batch.cameras.cropped(self.top, self.left, self.height, self.width),
            corners=self._corners(batch),
        )

    def _corners(self, batch: Batch) -> Int[Tensor, "B V 2"]:
        shape, device = batch.masks.shape[:2], batch.masks.device
        starts = (torch.as_tensor(start, device=device).expand(shape) for start in (self.top, self.left))
        corners = torch.stack(tuple(starts), dim=-1)
        return corners if batch.corners is None else corners + batch.corners

    def paste_prediction(self, prediction: Prediction) -> Prediction:
        """The prediction of a cut batch on the photographs; nothing is valid outside the crop."""
        maps, gaussians = prediction.depth_maps, prediction.gaussians
        bounds = maps.bounds
        if bounds is not None:
            bounds = DepthBounds(self.paste(bounds.near, 1.0), self.paste(bounds.far, 1.0))
        whole = dataclasses.replace(
            maps,
            depth=self.paste(maps.depth, 1.0),
            valid=self.paste(maps.valid, False),
            confidence=self.paste(maps.confidence, 1.0),
            bounds=bounds,
        )
        top, left = (
            start if isinstance(start, int) else start.flatten()[gaussians.image]
            for start in (self.top, self.left)
        )
        row, column = gaussians.pixel // self.width + top, gaussians.pixel % self.width + left
        pixels = self.paste(prediction.points.pixels, 0.0)
        return Prediction(
            gaussians=dataclasses.replace(gaussians, pixel=row * self.full[1] + column),
            depth=whole.depth,
            depth_valid=whole.valid,
            points=dataclasses.replace(prediction.points, pixels=pixels, valid=whole.valid),
            depth_maps=whole,
        )


@dataclass(frozen=True)
class PaddedCrop(Crop):
    """The photographs in the middle of a larger image: ``top`` and ``left`` are 0 or negative."""

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
class SubjectCrop(Crop):
    """One crop for each view, all of one size, inside the photographs."""

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
        """Indices of the crops in maps [B, V, H, W, ...]."""
        b, v = self.top.shape
        device = self.top.device
        element = torch.arange(b, device=device)[:, None, None, None]
        view = torch.arange(v, device=device)[:, None, None]
        rows = self.top[..., None, None] + torch.arange(self.height, device=device)[:, None]
        columns = self.left[..., None, None] + torch.arange(self.width, device=device)
        return element, view, rows, columns


def pad_to_patches(masks: Bool[Tensor, "B V H W"], multiple: int) -> PaddedCrop | None:
    """The smallest border that makes both sides multiples; an odd pixel goes below and to the right.

    512 becomes 518 with 3 pixels on each side, as in the authors' release.

    Args:
        masks: only their size is read.
        multiple: the patch size in pixels.

    Returns:
        None where both sides are multiples already.
    """
    height, width = masks.shape[2:]
    missing = (-height % multiple, -width % multiple)
    if missing == (0, 0):
        return None
    sides = (height + missing[0], width + missing[1])
    return PaddedCrop(-(missing[0] // 2), -(missing[1] // 2), *sides, full=(height, width))


def crops_to_subject(
    masks: Bool[Tensor, "B V H W"], multiple: int, margin: int = 2
) -> list[tuple[Int[Tensor, " n"], SubjectCrop]]:
    """Crops that hold the mask of every view, for each group of elements with crops of one size.

    One size serves the views of an element: that of its largest mask. It does not depend on the other
    elements. A view with an empty mask gets the middle of its image.

    Args:
        masks: of the photographs.
        multiple: sides are rounded up to it; the patch size, which divides the photographs.
        margin: pixels around the mask, where the photograph has them.

    Returns:
        The elements of each group, and their crop.
    """
    middles, sizes = [], []
    for axis in (2, 3):
        length = masks.shape[axis]
        first, last = first_and_last(masks.any(5 - axis))
        first, last = (torch.where(last < 0, length // 2, end) for end in (first, last))
        needed = (last - first).amax(1) + 1 + 2 * margin
        sizes.append((-(-needed // multiple) * multiple).clamp(max=length))
        middles.append(first + last + 1)
    groups: dict[tuple[int, int], list[int]] = {}
    for element, size in enumerate(torch.stack(sizes, -1).tolist()):
        groups.setdefault(tuple(size), []).append(element)
    full, found = tuple(masks.shape[2:]), []
    for size, elements in groups.items():
        index = torch.tensor(elements, device=masks.device)
        # Integer division keeps the middle; the clamp keeps the crop inside the image.
        starts = [
            ((middle[index] - side) // 2).clamp(0, length - side)
            for middle, side, length in zip(middles, size, full, strict=True)
        ]
        found.append((index, SubjectCrop(*starts, *size, full=full)))
    return found
