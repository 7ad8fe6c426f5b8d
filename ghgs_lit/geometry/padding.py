"""A black border around photographs whose sides are not multiples of the patch size. Predictions
are cropped again, so that results are in the photograph's own pixels."""

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
    """Images of ``height`` x ``width`` with photographs of size ``full`` (height, width) inside.
    Their first pixel is pixel (``top``, ``left``) of the photograph: 0 or negative."""

    top: int
    left: int
    height: int
    width: int
    full: tuple[int, int]

    def pad(self, maps: Tensor, fill: float | bool = 0) -> Tensor:
        """Maps of photographs with a border.

        Args:
            maps: [B, V, H, W, ...] of the photographs.
            fill: value of the border.

        Returns:
            Maps [B, V, height, width, ...].
        """
        return F.pad(maps, self._sides(maps), value=fill)

    def cut(self, maps: Tensor) -> Tensor:
        """Maps without their border."""
        return F.pad(maps, [-side for side in self._sides(maps)])

    def pad_batch(self, batch: Batch) -> "PaddedBatch":
        """The batch with a border around every input; targets are unchanged."""
        kept = {field.name: getattr(batch, field.name) for field in dataclasses.fields(Batch)}
        return dataclasses.replace(
            PaddedBatch(**kept, photographs=batch, padding=self),
            images=self.pad(batch.images.movedim(2, -1)).movedim(-1, 2),
            masks=self.pad(batch.masks, False),
            depths=None if batch.depths is None else self.pad(batch.depths),
            alpha=None if batch.alpha is None else self.pad(batch.alpha),
            cameras=batch.cameras.cropped(self.top, self.left, self.height, self.width),
        )

    def cut_prediction(self, prediction: Prediction) -> Prediction:
        """The prediction of a padded batch in the pixels of the photographs."""
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
            drafts=tuple(self._cut_gaussians(draft) for draft in prediction.drafts),
        )

    def _cut_maps(self, maps: DepthMaps) -> DepthMaps:
        return map_tensors(maps, self.cut)

    def _cut_gaussians(self, gaussians: Gaussians) -> Gaussians:
        return dataclasses.replace(gaussians, pixel=self._cut_pixel(gaussians.pixel))

    def _cut_pixel(self, pixel: Int[Tensor, " n"]) -> Int[Tensor, " n"]:
        """Indices of pixels of an image in that of its photograph."""
        row = pixel // self.width + self.top
        column = pixel % self.width + self.left
        return row * self.full[1] + column

    def cut_pixels(self, pixels: Int[Tensor, " n"]) -> Int[Tensor, " n"]:
        """Indices of pixels among those of all images, as indices among those of all photographs.

        Args:
            pixels: that lie within the photographs [n].

        Returns:
            Indices [n].
        """
        image = pixels // (self.height * self.width)
        pixel = pixels % (self.height * self.width)
        return image * (self.full[0] * self.full[1]) + self._cut_pixel(pixel)

    def cut_extent(self, extent: Extent) -> Extent:
        """The extent of a mask, or of a window around it, without its border."""
        height, width = self.full
        rows = (min(max(row + self.top, 0), height) for row in extent[1:3])
        columns = (min(max(column + self.left, 0), width) for column in extent[3:])
        return Extent(extent.count, *rows, *columns)

    def _sides(self, maps: Tensor) -> list[int]:
        """Widths of the border in the order of ``F.pad``: last axis first, before and after."""
        below = self.height - self.full[0] + self.top
        right = self.width - self.full[1] + self.left
        return [0, 0] * (maps.dim() - 4) + [-self.left, right, -self.top, below]


@dataclass(frozen=True)
class PaddedBatch(Batch):
    """Photographs with a border, and the batch without it."""

    photographs: Batch | None = None
    padding: Padding | None = None

    def note(
        self, extents: Sequence[Extent], pixels: Callable[[], Int[Tensor, " n"]], has_skew: bool
    ) -> None:
        """Keep them for the photographs, too, in their own pixels."""
        super().note(extents, pixels, has_skew)
        inner = [self.padding.cut_extent(extent) for extent in extents]
        self.photographs.note(inner, lambda: self.padding.cut_pixels(self.pixels), has_skew)


def bounds_of(stage: Callable[[Batch], DepthBounds | None], batch: Batch) -> DepthBounds | None:
    """Bounds of all pixels, from the photographs without their border,
    which would look like background.

    Args:
        stage: gives the bounds of a batch, or None.
        batch: padded or not.

    Returns:
        Bounds of the pixels of ``batch``; depths in a border have no meaning.
    """
    if not isinstance(batch, PaddedBatch):
        return stage(batch)
    bounds = stage(batch.photographs)  # depths in the border have no meaning
    return bounds and map_tensors(bounds, lambda depths: batch.padding.pad(depths, 1.0))


def pad_to_patches(masks: Bool[Tensor, "B V H W"], multiple: int) -> Padding | None:
    """The smallest border that makes both sides multiples;
    an odd pixel goes to the bottom and the right.

    512 becomes 518 with 3 pixels on each side, as in the authors' release.

    Args:
        masks: [B, V, H, W], of which the size is read.
        multiple: side of a patch in pixels.

    Returns:
        The border; None if both sides are multiples.
    """
    height, width = masks.shape[2:]
    missing = (-height % multiple, -width % multiple)
    if missing == (0, 0):
        return None
    sides = (height + missing[0], width + missing[1])
    return Padding(-(missing[0] // 2), -(missing[1] // 2), *sides, full=(height, width))
