"""Variation of training batches: sizes of images, and what goes wrong in captures.

A batch is a function of (seed, step, index) alone, as its samples are, so that runs resume exactly.
"""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ghgs_lit.config.settings import image_size, set_fields
from ghgs_lit.data.imperfections import backgrounds, color_gains, imperfect_mask, miscalibrated
from ghgs_lit.data.matting import refined_matte
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
        background: share of the samples with such masks that were taken before :func:`backgrounds`, which a
            mask that is too large shows; behind the others it is black.
        refined: share of the samples before a background whose masks were refined
            (:func:`ghgs_lit.data.matting.refined_matte`), as a capture's are with ``refine_masks``.
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
    background: float = 0.0
    refined: float = 0.0
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
        for name in ("chance", "background", "refined"):
            require(getattr(self, name) <= 1, f"augmentation.{name}", "at most 1", getattr(self, name))
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
        streams = [rng.spawn(4) for rng in rngs]
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
            known = masks.to(images) if alpha is None else alpha
            found = [
                self._segmented(images[b], masks[b], known[b], s[2], s[3]) for b, s in enumerate(streams)
            ]
            images, masks, mattes = (torch.stack(parts) for parts in zip(*found, strict=True))
            alpha = None if alpha is None else mattes
        return dataclasses.replace(batch, images=images, masks=masks, cameras=cameras, alpha=alpha)

    def _segmented(
        self,
        images: Float[Tensor, "V 3 h w"],
        masks: Bool[Tensor, "V h w"],
        mattes: Float[Tensor, "V h w"],
        outlines: np.random.Generator,
        behind: np.random.Generator,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Images, masks and mattes of one sample as a segmentation gives them."""
        wrong = self._masks(masks, outlines)
        has_background, is_refined = behind.uniform(size=2) < (self.background, self.refined)
        if not has_background:
            # What a segmentation takes for the subject it takes for all of a pixel.
            return images * wrong[:, None], wrong, torch.where(wrong > masks, 1, mattes * wrong)
        patterns = torch.from_numpy(backgrounds(*masks.shape, behind)).to(images)
        # Brightened colours may be more than their share of a pixel.
        photographs = (images + (1 - mattes[:, None]) * patterns).clamp(max=1)
        if not is_refined:
            return photographs * wrong[:, None], wrong, wrong.to(images)
        bytes_ = (255 * photographs).round().byte().movedim(1, -1).numpy()
        pixels = max(1, math.ceil(self.mask_offset + self.mask_ragged))
        pairs = [
            refined_matte(image, 255 * mask, pixels)
            for image, mask in zip(bytes_, wrong.byte().numpy(), strict=True)
        ]
        subjects, found = (
            torch.from_numpy(np.stack(each)).to(images) / 255 for each in zip(*pairs, strict=True)
        )
        kept = (found > 0.5).flatten(1).any(1)[:, None, None]  # no mask is emptied
        found = torch.where(kept, found, wrong.to(images))
        images = torch.where(kept[:, None], subjects.movedim(-1, 1), photographs * wrong[:, None])
        return images, found > 0.5, found

    def _masks(self, masks: Tensor, rng: np.random.Generator) -> Tensor:
        limits = (self.mask_offset, self.mask_ragged, self.mask_hole, self.mask_hole_chance)
        return torch.from_numpy(np.stack([imperfect_mask(mask, *limits, rng) for mask in masks.numpy()]))
