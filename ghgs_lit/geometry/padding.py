"""Padding of images whose sides are not multiples of the patch size.

Predictions are cropped back to the pixels of the unpadded images."""

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch.nn.functional as F
from jaxtyping import Bool, Int
from torch import Tensor

from ghgs_lit.extents import Extent
from ghgs_lit.types import Batch, DepthBounds, DepthMaps, Gaussians, Prediction, map_tensors


@dataclass(frozen=True)
class Padding:
    """Placement of images of size ``full`` (height, width) inside padded ones of ``height`` x
    ``width``. The first padded pixel is pixel (``top``, ``left``) of the image: 0 or negative."""

    top: int
    left: int
    height: int
    width: int
    full: tuple[int, int]

    def pad(self, maps: Tensor, fill: float | bool = 0) -> Tensor:
        """Pad maps [B, V, H, W, ...] to [B, V, height, width, ...] with ``fill``."""
        return F.pad(maps, self._sides(maps), value=fill)

    def cut(self, maps: Tensor) -> Tensor:
        """Crop padded maps [B, V, height, width, ...] to the size of the images."""
        return F.pad(maps, [-side for side in self._sides(maps)])

    def pad_batch(self, batch: Batch) -> "PaddedBatch":
        """Pad every input of a batch; targets are unchanged."""
        kept = {field.name: getattr(batch, field.name) for field in dataclasses.fields(Batch)}
        return dataclasses.replace(
            PaddedBatch(**kept, photographs=batch, padding=self),
            images=self.pad(batch.images.movedim(2, -1)).movedim(-1, 2),
            masks=self.pad(batch.masks, False),
            depths=None if batch.depths is None else self.pad(batch.depths),
            alpha=None if batch.alpha is None else self.pad(batch.alpha),
            cameras=batch.cameras.crop(self.top, self.left, self.height, self.width),
        )

    def cut_prediction(self, prediction: Prediction) -> Prediction:
        """Crop the prediction of a padded batch to the pixels of the images."""
        whole = self._cut_maps(prediction.depth_maps)
        pixels = self.cut(prediction.points.pixels)
        return dataclasses.replace(
            prediction,
            gaussians=self._cut_gaussians(prediction.gaussians),
            depth=whole.depth,
            depth_valid=whole.valid,
            points=dataclasses.replace(prediction.points, pixels=pixels, valid=whole.valid),
            depth_maps=whole,
            rounds=tuple(self._cut_maps(maps) for maps in prediction.rounds),
        )

    def _cut_maps(self, maps: DepthMaps) -> DepthMaps:
        return map_tensors(maps, self.cut)

    def _cut_gaussians(self, gaussians: Gaussians) -> Gaussians:
        return dataclasses.replace(gaussians, pixel=self._cut_pixel(gaussians.pixel))

    def _cut_pixel(self, pixel: Int[Tensor, " n"]) -> Int[Tensor, " n"]:
        """Convert indices of pixels within a padded image to those within the image."""
        row = pixel // self.width + self.top
        column = pixel % self.width + self.left
        return row * self.full[1] + column

    def cut_pixels(self, pixels: Int[Tensor, " n"]) -> Int[Tensor, " n"]:
        """Convert flat pixel indices over all padded images to those over all unpadded images.

        Args:
            pixels: indices [n] of pixels outside the padding.
        """
        image = pixels // (self.height * self.width)
        pixel = pixels % (self.height * self.width)
        return image * (self.full[0] * self.full[1]) + self._cut_pixel(pixel)

    def cut_extent(self, extent: Extent) -> Extent:
        """Clip the extent of a padded mask, or of a window around it, to the pixels of the image."""
        height, width = self.full
        rows = (min(max(row + self.top, 0), height) for row in extent[1:3])
        columns = (min(max(column + self.left, 0), width) for column in extent[3:])
        return Extent(extent.count, *rows, *columns)

    def _sides(self, maps: Tensor) -> list[int]:
        """Widths of the padding in the order of ``F.pad``: last axis first, before and after."""
        below = self.height - self.full[0] + self.top
        right = self.width - self.full[1] + self.left
        return [0, 0] * (maps.dim() - 4) + [-self.left, right, -self.top, below]


@dataclass(frozen=True)
class PaddedBatch(Batch):
    """Padded batch, together with the unpadded one (``photographs``)."""

    photographs: Batch | None = None
    padding: Padding | None = None

    def note(
        self, extents: Sequence[Extent], pixels: Callable[[], Int[Tensor, " n"]], has_skew: bool
    ) -> None:
        """Record them for the unpadded batch, too, in its pixels."""
        super().note(extents, pixels, has_skew)
        inner = [self.padding.cut_extent(extent) for extent in extents]
        self.photographs.note(inner, lambda: self.padding.cut_pixels(self.pixels), has_skew)


def bounds_of(stage: Callable[[Batch], DepthBounds | None], batch: Batch) -> DepthBounds | None:
    """Depth bounds of a batch, computed from its unpadded images: padding would count as background.

    Args:
        stage: computes the bounds of a batch, or None.
        batch: padded or not.

    Returns:
        Bounds of the pixels of ``batch``; depths in the padding have no meaning.
    """
    if not isinstance(batch, PaddedBatch):
        return stage(batch)
    bounds = stage(batch.photographs)
    return bounds and map_tensors(bounds, lambda depths: batch.padding.pad(depths, 1.0))


def pad_to_patches(masks: Bool[Tensor, "B V H W"], multiple: int) -> Padding | None:
    """Smallest padding that makes both sides multiples, or None if they are.

    An odd pixel goes to the bottom and the right. 512 becomes 518 with 3 pixels on each side, as in
    the authors' release.

    Args:
        masks: [B, V, H, W]; only the size matters.
        multiple: side of a patch in pixels.
    """
    height, width = masks.shape[2:]
    missing = (-height % multiple, -width % multiple)
    if missing == (0, 0):
        return None
    sides = (height + missing[0], width + missing[1])
    return Padding(-(missing[0] // 2), -(missing[1] // 2), *sides, full=(height, width))
