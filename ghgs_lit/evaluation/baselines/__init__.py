"""Baselines: methods that a user might pick instead of a model,
and simple ones that it must beat."""

from collections.abc import Callable
from functools import partial

import torch
import torch.nn.functional as F

from ghgs_lit.config import nodes
from ghgs_lit.errors import choice
from ghgs_lit.evaluation.baselines.splats import (
    PerScene,
    body_depth,
    hull_depth,
    photo_depth,
    splats_at,
    splatted,
    true_depth,
)
from ghgs_lit.evaluation.measure import Estimate, Method, ModelMethod, Renderer
from ghgs_lit.types import Batch, Prediction

__all__ = ["BASELINES", "baseline", "black", "nearest_view", "splats_at", "splatted"]

#: Depth of the discs of a baseline, by name.
DEPTHS = {"body_depth": body_depth, "hull": hull_depth, "photo_depth": photo_depth, "true_depth": true_depth}
BASELINES = ("black", "nearest_view", *DEPTHS, "per_scene", "untrained")


def baseline(
    name: str,
    renderer: Renderer,
    untrained: Callable[[], Callable[[Batch], Prediction]],
    per_scene: nodes.PerScene,
) -> Method:
    """The baseline of a name.

    Args:
        name: One of ``BASELINES``.
        renderer: Draws Gaussians from the target cameras.
        untrained: Builds what predicts with random weights, for ``untrained``.
        per_scene: Options of the baseline of that name.

    Returns:
        The method, which predicts a batch without training.

    Raises:
        InputError: There is no such baseline.
    """
    choice("baselines", name, BASELINES)
    if name in DEPTHS:
        return partial(splatted, depth_of=DEPTHS[name], renderer=renderer)
    if name == "per_scene":
        return PerScene(renderer, per_scene.steps)
    if name == "untrained":
        return ModelMethod(untrained(), renderer)
    return {"black": black, "nearest_view": nearest_view}[name]


def black(batch: Batch) -> Estimate:
    """A black image, which scores the background alone.

    Args:
        batch: With targets of T photographs of h x w pixels.

    Returns:
        Zeros [B, T, 3, h, w].
    """
    return Estimate(torch.zeros_like(batch.targets.images))


def nearest_view(batch: Batch) -> Estimate:
    """The input photograph whose viewing direction is nearest to that of the target.

    Args:
        batch: With photographs [B, V, 3, H, W] and targets of h x w pixels.

    Returns:
        For each target that photograph, at the target's size.
    """
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
