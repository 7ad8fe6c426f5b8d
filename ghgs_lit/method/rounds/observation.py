"""Sampling of input views and renders at the positions of Gaussians, without a gradient."""

import dataclasses

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ghgs_lit.geometry.masks import coverage, on_black
from ghgs_lit.geometry.precision import exact
from ghgs_lit.geometry.projection import at_least_float32
from ghgs_lit.geometry.rotations import rotate, unit
from ghgs_lit.ops.observation import observations, values_at
from ghgs_lit.rendering import render
from ghgs_lit.types import Batch, Cameras, Gaussians, Rendering, map_tensors

#: Scale in metres of a Gaussian's distance behind the rendered surface (tanh of the ratio).
_BEHIND = 0.05

#: Channels of :func:`slopes`: mean along its ray and along the Gaussian's axes, scales, opacity, color.
SLOPES = 1 + 3 + 3 + 1 + 3
# Slopes saturate above about 1/4; most are below a tenth.
_STEEP = 4.0


@torch.inference_mode(False)
def slopes(
    gaussians: Gaussians, batch: Batch, directions: Float[Tensor, "N 3"], footprints: Float[Tensor, "N 1"]
) -> tuple[Rendering, Float[Tensor, "N s"]]:
    """Render the input views, and compute the bounded gradient of their squared error with respect to
    each Gaussian.

    The error is that of colours and mattes. Units are pixels for means, logarithms for scales, logits
    for opacities. No gradient flows through the values.

    Args:
        gaussians: Gaussians of the batch.
        batch: images and mattes to compare with the renders.
        directions: directions of the rays of the Gaussians' pixels.
        footprints: size of a pixel at each Gaussian's depth, in the unit of depth.

    Returns:
        Renders from the cameras of the batch, and :data:`SLOPES` values in [-1, 1] of each Gaussian.
    """
    # Copies, since inference tensors cannot require gradients.
    means, scales, opacities, colors = leaves = [
        getattr(gaussians, name).detach().clone().requires_grad_()
        for name in ("means", "scales", "opacities", "colors")
    ]
    quaternions = gaussians.quaternions.detach().clone()
    cameras = batch.cameras
    if cameras.extrinsics.is_inference():
        cameras = map_tensors(cameras, Tensor.clone)
    shown = dataclasses.replace(
        gaussians, means=means, scales=scales, quaternions=quaternions, opacities=opacities, colors=colors
    )
    with exact(means.device.type), torch.enable_grad():
        drawn = render(shown, cameras)
        rendering = map_tensors(drawn, Tensor.detach)
        # Differences are the gradients of half the squared error.
        wrong = (rendering.image - on_black(batch), rendering.alpha - coverage(batch)[:, :, None])
        of_means, of_scales, of_opacities, of_colors = torch.autograd.grad(
            (drawn.image, drawn.alpha), leaves, wrong
        )
    with torch.no_grad():
        of_means = of_means * footprints
        along = (of_means * directions).sum(-1, keepdim=True) / directions.norm(dim=-1, keepdim=True)
        inverse = torch.cat((quaternions[:, :1], -quaternions[:, 1:]), -1)
        across = rotate(unit(inverse), of_means)
        logits = of_opacities * opacities * (1 - opacities)
        values = torch.cat((along, across, of_scales * scales, logits[:, None], of_colors), -1)
        return rendering, torch.tanh(_STEEP * values)


@torch.no_grad()
def observe(gaussians: Gaussians, batch: Batch, rendering: Rendering | None = None) -> Float[Tensor, "N V c"]:
    """:data:`CHANNELS` values of each Gaussian in each view: its own first, then the others in cyclic
    order.

    Args:
        gaussians: Gaussians of the batch with their pixels.
        batch: images, masks, mattes and cameras are read.
        rendering: render of the Gaussians from these cameras; None: rendered here.
    """
    with exact(gaussians.means.device.type):
        rendering = rendering or render(gaussians, batch.cameras)
        cameras = batch.cameras
        seen = (gaussians.means, gaussians.colors, gaussians.image, cameras.intrinsics, cameras.extrinsics)
        maps = (coverage(batch), rendering.image, rendering.alpha, rendering.depth)
        return observations(*seen, at_least_float32(batch.images), *maps, _BEHIND, gaussians.splits)


def sample_maps(
    gaussians: Gaussians, cameras: Cameras, maps: Float[Tensor, "B V c H W"]
) -> tuple[Float[Tensor, "N V c"], Float[Tensor, "N V 1"], Bool[Tensor, "N V 1"]]:
    """Sample maps bilinearly at projected means; 0 beyond the border.

    Args:
        gaussians: Gaussians of B elements.
        cameras: [B, V], of the maps.
        maps: maps of all views.

    Returns:
        Values in each view, depths z there, and whether the means are in view: inside the frame and
        in front of the camera.
    """
    return values_at(gaussians.means, gaussians.image, gaussians.splits, cameras, maps)
