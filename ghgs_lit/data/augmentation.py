"""Augmentation of training batches: image sizes and imperfections of captures.

Like its samples, an augmented batch depends only on (seed, step, index), so that runs resume exactly.
"""

import dataclasses
import math
from collections.abc import Sequence
from typing import Annotated

import numpy as np
import torch
from jaxtyping import Bool, Float
from pydantic import Field, model_validator
from torch import Tensor

from ghgs_lit.config import options
from ghgs_lit.config.options import Amount, Count, Options, Positive, Share
from ghgs_lit.data.imperfections import (
    change_tones,
    cut_subjects,
    perturb_cameras,
    perturb_mask,
    sample_backgrounds,
    sample_color_gains,
    sample_tone_powers,
)
from ghgs_lit.data.matting import refine_matte
from ghgs_lit.types import Batch, Cameras

# Keys of random streams, in addition to those of ghgs_lit.data.sampling.
_SIZES = 3
_IMPERFECTIONS = 4
_CHANCE = 5

#: Maximum diameter of a missing piece of a mask, such as a hand or foot, as a fraction of the
#: subject's height.
HOLE = 0.12

Size = tuple[int, int]
Stops = Annotated[float, Field(ge=0, le=16)]
Pixels = Annotated[float, Field(ge=0, le=64)]


class Augmentation(Options):
    """Augmentation of training batches; null and 0: none. Pixels are those of the inputs at their
    sampled size. Targets keep their colours and cameras, except that principal points move with cut
    subjects. Depth maps keep the z-depths in the true cameras: the depth loss compares with the true
    distance of the surface, not with one that compensates for the error of a camera."""

    group = "augmentation"

    sizes: tuple[options.Size, ...] | None = None
    """Sides or [height, width] of the inputs in pixels; each step samples one, the same in all
    processes."""
    target_scale: tuple[Positive, Positive] | None = None
    """[minimum, maximum] ratio of the sizes of targets and inputs, sampled likewise. Targets are never
    larger than data.target_size, as enlarged images would teach blur."""
    chance: Share = 1.0
    """Share of the steps whose inputs get the imperfections below."""
    exact_from: Count | None = None
    """Training step from which on inputs have no imperfections, for the last part of a run;
    null: never."""
    exposure: Stops = 0.0
    """Maximum deviation of the exposure of single cameras, in stops; 16 span black to white."""
    white_balance: Stops = 0.0
    """Maximum deviation of red and of blue of single cameras, in stops."""
    gamma: Share = 0.0
    """Maximum natural logarithm of the power to which single cameras raise colours, as their tone
    curve."""
    cut: Share = 0.0
    """Share of the samples whose feet or legs are outside the frame, in all images or in some."""
    mask_offset: Pixels = 0.0
    """Maximum growth or shrinkage of masks in pixels; inputs are then black outside them."""
    mask_ragged: Pixels = 0.0
    """Maximum height in pixels of bumps along the outlines of masks."""
    mask_hole_chance: Share = 0.0
    """Probability that a piece of a mask is missing, with a diameter of up to 0.12 of the subject's
    height."""
    background: Share = 0.0
    """Share of the samples with perturbed masks that get a background, which is visible where a mask is
    too large; the others are on black."""
    refined: Share = 0.0
    """Share of the samples with a background whose masks are then refined, as by refine_masks."""
    calibration: Amount = 0.0
    """Maximum error of the input cameras in pixels."""

    @model_validator(mode="after")
    def _check(self) -> "Augmentation":
        self.require(self.sizes != (), "sizes", "sizes or null")
        low, high = self.target_scale or (1, 1)
        self.require(low <= high, "target_scale", "[least, greatest] above 0")
        return self

    @property
    def changes_photographs(self) -> bool:
        """Whether the pixels of an input image can differ between steps."""
        limits = (self.exposure, self.white_balance, self.gamma, self.cut, *self._of_masks)
        return self.sizes is not None or (self.chance > 0 and any(limits))

    @property
    def _of_masks(self) -> tuple[float, float, float]:
        return self.mask_offset, self.mask_ragged, self.mask_hole_chance

    @property
    def varies_sizes(self) -> bool:
        """Whether steps have inputs or targets of different sizes."""
        return self.sizes is not None or self.target_scale is not None

    def sample_sizes(self, size: Size, target: Size, seed: int, step: int) -> tuple[Size, Size]:
        """Sample the sizes of the inputs and targets of a step.

        Args:
            size: configured (height, width) of the inputs in pixels.
            target: configured (height, width) of the targets in pixels, which sampled sizes never
                exceed.
            step: training step, equal in all processes.

        Returns:
            (height, width) of the inputs and of the targets in pixels.
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

    def augment(self, batch: Batch, seed: int, step: int, indices: Sequence[int]) -> Batch:
        """Apply the imperfections of captures to a batch in a share ``chance`` of the steps.

        Args:
            batch: samples as read from disk.
            indices: indices of the samples in the run.

        Returns:
            The batch, unchanged in steps without imperfections; otherwise see :meth:`add_imperfections`.
        """
        limits = (self.exposure, self.white_balance, self.gamma, self.cut, self.calibration, *self._of_masks)
        is_last = self.exact_from is not None and step >= self.exact_from
        if is_last or not any(limits):
            return batch
        if np.random.default_rng([seed, _CHANCE, step]).uniform() >= self.chance:
            return batch
        rngs = [np.random.default_rng([seed, _IMPERFECTIONS, step, index]) for index in indices]
        return self.add_imperfections(batch, rngs)

    def add_imperfections(self, batch: Batch, rngs: Sequence[np.random.Generator]) -> Batch:
        """Apply the imperfections of captures to a batch. Images stay in [0, 1], and no mask becomes
        empty.

        Args:
            batch: a batch with at least two views.
            rngs: generator of each element; each kind of imperfection uses its own stream.
        """
        streams = [rng.spawn(6) for rng in rngs]
        if self.cut:
            batch = cut_subjects(batch, self.cut, [s[4] for s in streams])
        images = batch.images
        masks = batch.masks
        cameras = batch.cameras
        alpha = batch.alpha
        if self.exposure or self.white_balance:
            views = masks.shape[1]
            gains = [sample_color_gains(views, self.exposure, self.white_balance, s[0]) for s in streams]
            images = (images * torch.from_numpy(np.stack(gains)).to(images)[..., None, None]).clamp(0, 1)
        if self.gamma:
            powers = np.stack([sample_tone_powers(masks.shape[1], self.gamma, s[5]) for s in streams])
            images = change_tones(images, alpha, torch.from_numpy(powers).to(images))
        if self.calibration:
            wrong = [
                perturb_cameras(cameras[b], masks[b], self.calibration, s[1]) for b, s in enumerate(streams)
            ]
            matrices = zip(*((one.intrinsics, one.extrinsics) for one in wrong), strict=True)
            cameras = Cameras(*map(torch.stack, matrices), cameras.height, cameras.width)
        if any(self._of_masks):
            known = masks.to(images) if alpha is None else alpha
            segmented = [
                self._segment(images[b], masks[b], known[b], s[2], s[3]) for b, s in enumerate(streams)
            ]
            images, masks, mattes = (torch.stack(parts) for parts in zip(*segmented, strict=True))
            alpha = None if alpha is None else mattes
        return dataclasses.replace(batch, images=images, masks=masks, cameras=cameras, alpha=alpha)

    def _segment(
        self,
        images: Float[Tensor, "V 3 h w"],
        masks: Bool[Tensor, "V h w"],
        mattes: Float[Tensor, "V h w"],
        outlines: np.random.Generator,
        behind: np.random.Generator,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Images on black, masks and mattes of one element, with the errors of a segmentation."""
        limits = (self.mask_offset, self.mask_ragged, HOLE, self.mask_hole_chance)
        wrong = torch.from_numpy(np.stack([perturb_mask(mask, *limits, outlines) for mask in masks.numpy()]))
        has_background, is_refined = behind.uniform(size=2) < (self.background, self.refined)
        if not has_background:
            # Pixels that the segmentation adds get a matte of 1.
            return images * wrong[:, None], wrong, torch.where(wrong > masks, 1, mattes * wrong)
        patterns = torch.from_numpy(sample_backgrounds(*masks.shape, behind)).to(images)
        # Brightened colours may exceed the share of the pixel that they cover.
        photographs = (images + (1 - mattes[:, None]) * patterns).clamp(max=1)
        if not is_refined:
            return photographs * wrong[:, None], wrong, wrong.to(images)
        bytes_ = (255 * photographs).round().byte().movedim(1, -1).numpy()
        pixels = max(1, math.ceil(self.mask_offset + self.mask_ragged))
        pairs = [
            refine_matte(image, 255 * mask, pixels)
            for image, mask in zip(bytes_, wrong.byte().numpy(), strict=True)
        ]
        subjects, refined = (
            torch.from_numpy(np.stack(each)).to(images) / 255 for each in zip(*pairs, strict=True)
        )
        kept = (refined > 0.5).flatten(1).any(1)[:, None, None]  # no mask becomes empty
        refined = torch.where(kept, refined, wrong.to(images))
        images = torch.where(kept[:, None], subjects.movedim(-1, 1), photographs * wrong[:, None])
        return images, refined > 0.5, refined
