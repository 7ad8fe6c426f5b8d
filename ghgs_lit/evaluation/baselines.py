"""Simple methods that a model must beat, measured on the same targets."""

from collections.abc import Callable
from functools import partial

import torch
import torch.nn.functional as F
from torch import Tensor

from ghgs_lit.errors import InputError, choice
from ghgs_lit.evaluation.measure import Estimate, Method, ModelMethod, Renderer
from ghgs_lit.geometry.projection import unproject_maps, world_to_camera
from ghgs_lit.types import Batch, Gaussians

BASELINES = ("black", "nearest_view", "body_depth", "true_depth", "untrained")


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


def splats_at(
    batch: Batch, depth: Tensor, valid: Tensor, sigma: float = 0.3, opacity: float = 0.9
) -> Gaussians:
    """Round splats for pixels of the inputs.

    Args:
        batch: gives cameras and colours.
        depth: where the splats are [B, V, H, W], metres.
        valid: pixels that get a splat [B, V, H, W].
        sigma: standard deviation in pixels of the input.
        opacity: in (0, 1).
    """
    points = unproject_maps(depth, batch.cameras)[valid]
    focal = batch.cameras.intrinsics.diagonal(dim1=-2, dim2=-1)[..., :2].mean(-1)
    scale = (sigma * depth / focal[..., None, None])[valid]
    return Gaussians(
        means=points,
        quaternions=points.new_tensor([1.0, 0.0, 0.0, 0.0]).expand(len(points), 4),
        scales=scale[:, None].expand(-1, 3),
        opacities=torch.full_like(scale, opacity),
        colors=batch.images.movedim(2, -1)[valid],
        splits=tuple(valid.flatten(1).sum(1).tolist()),
    )


def _body_depth(batch: Batch) -> Tensor:
    """Mean depth of the body's vertices in each view, as maps [B, V, H, W] in metres."""
    if batch.body_vertices is None:
        raise InputError("baselines: body_depth expects body vertices in the data; found none")
    means = [
        world_to_camera(vertices.expand(len(cameras), -1, -1), cameras[:, None])[..., 2].mean(-1)
        for vertices, cameras in zip(batch.body_vertices, batch.cameras.extrinsics, strict=True)
    ]
    return torch.stack(means)[..., None, None].expand(batch.masks.shape)


def _true_depth(batch: Batch) -> Tensor:
    if batch.depths is None:
        raise InputError("baselines: true_depth expects depth maps in the data; found none")
    return batch.depths


def splatted(
    batch: Batch,
    depth_of: Callable[[Batch], Tensor],
    renderer: Renderer,
    sigma: float = 0.3,
    opacity: float = 0.9,
) -> Estimate:
    """The subject's pixels as splats at a depth that is not learned.

    Args:
        batch: inputs and targets.
        depth_of: gives depths of the inputs [B, V, H, W], metres.
        renderer: draws the splats.
        sigma, opacity: as for :func:`splats_at`.
    """
    depth = depth_of(batch)
    valid = batch.masks & (depth > 0)
    gaussians = splats_at(batch, depth, valid, sigma, opacity)
    image = renderer(gaussians, batch.targets.cameras).image
    return Estimate(image, depth, valid, gaussians.splits)


def baseline(
    name: str,
    renderer: Renderer,
    untrained: Callable[[], torch.nn.Module],
    sigma: float = 0.3,
    opacity: float = 0.9,
) -> Method:
    """The baseline called ``name``, one of ``BASELINES``.

    Args:
        name: which one.
        renderer: draws its splats.
        untrained: builds a model with random weights, for the baseline ``untrained``.
        sigma, opacity: of the splats of ``body_depth`` and ``true_depth``, as for :func:`splats_at`.
    """
    choice("baselines", name, BASELINES)
    if name == "untrained":
        return ModelMethod(untrained().eval(), renderer)
    if name in ("body_depth", "true_depth"):
        depth_of = _body_depth if name == "body_depth" else _true_depth
        return partial(splatted, depth_of=depth_of, renderer=renderer, sigma=sigma, opacity=opacity)
    return {"black": black, "nearest_view": nearest_view}[name]
