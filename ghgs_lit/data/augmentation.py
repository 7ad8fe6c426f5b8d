"""Variation of training batches: sizes of images, and what goes wrong in captures.

A batch is a function of (seed, step, index) alone, as its samples are, so that runs resume exactly.
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ghgs_lit.config.settings import image_size, set_fields
from ghgs_lit.data.imperfections import color_gains, imperfect_mask, miscalibrated
from ghgs_lit.errors import require
from ghgs_lit.types import Batch, Cameras

# Streams of random numbers beside those of ghgs_lit.data.sampling.
_SIZES, _IMPERFECTIONS, _CHANCE = 3, 4, 5

Size = tuple[int, int]


@dataclass(frozen=True)
class Augmentation:
    """What varies in training; None and 0: nothing. Pixels are those of the inputs at their drawn size.

    Attributes:
        sizes: sides or (height, width) of the inputs; one is drawn for each step, the same in all processes.
        target_scale: least and greatest size of the targets over that of the inputs, drawn likewise; never
            larger than without it, as photographs that are enlarged teach blur.
        chance: share of the steps whose inputs are imperfect, 0 to 1.
        exposure, white_balance: in stops, as for :func:`color_gains`. Targets keep theirs.
        mask_offset, mask_ragged, mask_hole, mask_hole_chance: as for :func:`imperfect_mask`. The inputs are
            black outside their masks, as those of a capture.
        calibration: in pixels, as for :func:`miscalibrated`. Targets keep their true cameras, depth maps the
            z-depths in the true cameras: the loss on depth asks for the distance of the surface, not for one
            that makes up for the error of a camera.
    """

    sizes: tuple[Size, ...] | None = None
    target_scale: tuple[float, float] | None = None
    chance: float = 1.0
    exposure: float = 0.0
    white_balance: float = 0.0
    mask_offset: float = 0.0
    mask_ragged: float = 0.0
    mask_hole: float = 0.0
    mask_hole_chance: float = 0.0
    calibration: float = 0.0

    def __post_init__(self) -> None:
        if self.sizes is not None:
            require(len(self.sizes) > 0, "augmentation.sizes", "sizes or null", list(self.sizes))
            set_fields(self, sizes=tuple(image_size("augmentation.sizes", size) for size in self.sizes))
        if self.target_scale is not None:
            limits = tuple(self.target_scale)
            ordered = len(limits) == 2 and 0 < limits[0] <= limits[1]
            require(ordered, "augmentation.target_scale", "[least, greatest] above 0", list(limits))
            set_fields(self, target_scale=limits)
        require(self.chance <= 1, "augmentation.chance", "at most 1", self.chance)
        for field in dataclasses.fields(self)[2:]:
            value = getattr(self, field.name)
            require(value >= 0, f"augmentation.{field.name}", "at least 0", value)

    def draw_sizes(self, size: Size, target: Size, seed: int, step: int) -> tuple[Size, Size]:
        """Sizes of the inputs and of the targets of a step.

        Args:
            size, target: where none are drawn; the drawn inputs' targets keep this proportion.
            seed, step: of the run.
        """
        rng = np.random.default_rng([seed, _SIZES, step])
        chosen, share = rng.uniform(size=2)
        drawn = size if self.sizes is None else self.sizes[int(chosen * len(self.sizes))]
        if self.target_scale is None:
            ratios = [t / s for s, t in zip(size, target, strict=True)]
        else:
            low, high = self.target_scale
            ratios = [
                min(low + share * (high - low), *(t / d for t, d in zip(target, drawn, strict=True)))
            ] * 2
        return drawn, tuple(max(1, round(r * side)) for r, side in zip(ratios, drawn, strict=True))

    def imperfect(self, batch: Batch, seed: int, step: int, indices: Sequence[int]) -> Batch:
        """The batch of a training step, as imperfect captures show it in a share ``chance`` of the steps.

        Args:
            batch: its samples.
            seed, step: of the run.
            indices: numbers of the samples in the run.
        """
        if np.random.default_rng([seed, _CHANCE, step]).uniform() >= self.chance:
            return batch
        return self.imperfections(
            batch, [np.random.default_rng([seed, _IMPERFECTIONS, step, index]) for index in indices]
        )

    def imperfections(self, batch: Batch, rngs: Sequence[np.random.Generator]) -> Batch:
        """The batch as imperfect captures show it: images in [0, 1], no mask emptied.

        Args:
            batch: with at least two views.
            rngs: random numbers of each element. Whether one thing varies changes nothing about another.
        """
        streams = [rng.spawn(3) for rng in rngs]
        images, masks, cameras, alpha = batch.images, batch.masks, batch.cameras, batch.alpha
        if self.exposure or self.white_balance:
            views = masks.shape[1]
            gains = [color_gains(views, self.exposure, self.white_balance, s[0]) for s in streams]
            images = (images * torch.from_numpy(np.stack(gains)).to(images)[..., None, None]).clamp(0, 1)
        if self.calibration:
            found = [
                miscalibrated(cameras[b], masks[b], self.calibration, s[1]) for b, s in enumerate(streams)
            ]
            lenses, poses = (
                torch.stack([getattr(one, name) for one in found]) for name in ("intrinsics", "extrinsics")
            )
            cameras = Cameras(lenses, poses, cameras.height, cameras.width)
        if self.mask_offset or self.mask_ragged or self.mask_hole:
            masks = torch.stack([self._masks(masks[b], s[2]) for b, s in enumerate(streams)])
            images = images * masks[:, :, None]
            if alpha is not None:  # what a segmentation takes for the subject it takes for all of a pixel
                alpha = torch.where(masks > batch.masks, 1, alpha * masks)
        return dataclasses.replace(batch, images=images, masks=masks, cameras=cameras, alpha=alpha)

    def _masks(self, masks: Tensor, rng: np.random.Generator) -> Tensor:
        limits = (self.mask_offset, self.mask_ragged, self.mask_hole, self.mask_hole_chance)
        return torch.from_numpy(np.stack([imperfect_mask(mask, *limits, rng) for mask in masks.numpy()]))
