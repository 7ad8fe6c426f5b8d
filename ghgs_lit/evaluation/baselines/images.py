"""Baselines that are images of their own."""

import torch
import torch.nn.functional as F

from ghgs_lit.evaluation.measure import Estimate
from ghgs_lit.types import Batch


def black(batch: Batch) -> Estimate:
    """A black image: the score of the background alone."""
    return Estimate(torch.zeros_like(batch.targets.images))


def nearest_view(batch: Batch) -> Estimate:
    """The input photograph whose viewing direction is nearest to that of the target, at its size."""
    forward = batch.cameras.extrinsics[..., 2, :3]
    wanted = batch.targets.cameras.extrinsics[..., 2, :3]
    choice_of_view = torch.einsum("btk,bvk->btv", wanted, forward).argmax(-1)
    element = torch.arange(len(batch.images), device=batch.images.device)[:, None]
    images = batch.images[element, choice_of_view]
    size = batch.targets.images.shape[-2:]
    if images.shape[-2:] != size:
        flat = F.interpolate(images.flatten(0, 1), size, mode="bilinear", antialias=True, align_corners=False)
        images = flat.unflatten(0, images.shape[:2])
    return Estimate(images)
