"""Windows around the subject: most of a photograph is background that no Gaussian comes from."""

import dataclasses
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from ghgs_lit.types import Batch, Points, Prediction


@dataclass(frozen=True)
class Windows:
    """One window for each view, all ``height`` x ``width``, inside images of ``full`` (height, width)."""

    top: Int[Tensor, "B V"]
    left: Int[Tensor, "B V"]
    height: int
    width: int
    full: tuple[int, int]

    def _index(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Indices that pick the windows out of maps ``[B, V, H, W, ...]``."""
        b, v = self.top.shape
        device = self.top.device
        element = torch.arange(b, device=device)[:, None, None, None]
        view = torch.arange(v, device=device)[:, None, None]
        rows = self.top[..., None, None] + torch.arange(self.height, device=device)[:, None]
        columns = self.left[..., None, None] + torch.arange(self.width, device=device)
        return element, view, rows, columns

    def cut(self, maps: Tensor) -> Tensor:
        """The windows of maps ``[B, V, H, W, ...]``."""
        return maps[self._index()]

    def paste(self, maps: Tensor, fill: float | bool) -> Tensor:
        """Maps ``[B, V, H, W, ...]`` that are ``fill`` outside the windows."""
        whole = maps.new_full((*self.top.shape, *self.full, *maps.shape[4:]), fill)
        return whole.index_put(self._index(), maps)

    def cut_batch(self, batch: Batch) -> Batch:
        """The batch as if every input had been photographed through its window; targets stay."""
        intrinsics = batch.cameras.intrinsics.clone()
        intrinsics[..., 0, 2] -= self.left
        intrinsics[..., 1, 2] -= self.top
        cameras = dataclasses.replace(
            batch.cameras, intrinsics=intrinsics, height=self.height, width=self.width
        )
        return dataclasses.replace(
            batch,
            images=self.cut(batch.images.movedim(2, -1)).movedim(-1, 2),
            masks=self.cut(batch.masks),
            depths=None if batch.depths is None else self.cut(batch.depths),
            cameras=cameras,
        )

    def paste_prediction(self, prediction: Prediction) -> Prediction:
        """The prediction of a cut batch on the full images; outside the windows nothing is valid."""
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
        row = gaussians.pixel // self.width + self.top.flatten()[gaussians.image]
        column = gaussians.pixel % self.width + self.left.flatten()[gaussians.image]
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
