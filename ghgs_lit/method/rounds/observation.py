"""Values of photographs and renders at the positions of Gaussians, without a gradient."""

import dataclasses
from collections.abc import Sequence

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ghgs_lit.geometry.constants import constant
from ghgs_lit.geometry.masks import coverage, on_black
from ghgs_lit.geometry.projection import at_least_float32, project
from ghgs_lit.geometry.rotations import rotate, unit
from ghgs_lit.kernels import gpu
from ghgs_lit.kernels.pool import is_supported
from ghgs_lit.method.rounds import cpu
from ghgs_lit.rendering import render
from ghgs_lit.runtime.precision import exact
from ghgs_lit.types import Batch, Cameras, Gaussians, Rendering, map_tensors

#: Scale in metres of a Gaussian's distance behind the rendered surface (tanh of the ratio).
_BEHIND = 0.05

#: Values of a Gaussian in a view: photograph minus its own colour (3), photograph minus render
#: (3), mask, alpha, distance behind the rendered surface, whether the view can see it, whether the
#: view is its own.
CHANNELS = 11
#: Values of :func:`slopes`: of the mean along its ray and its own axes, of scales,
#: opacity and color.
SLOPES = 1 + 3 + 3 + 1 + 3
# Slopes saturate from about 1/4 on; most are less than a tenth.
_STEEP = 4.0


@torch.inference_mode(False)
def slopes(
    gaussians: Gaussians, batch: Batch, directions: Float[Tensor, "N 3"], footprints: Float[Tensor, "N 1"]
) -> tuple[Rendering, Float[Tensor, "N s"]]:
    """The rendered inputs, and the bounded gradient of their squared error with respect to
    each Gaussian.

    The error is of colours and mattes. Units are pixels for means, logarithms for scales, logits
    for opacities. No gradient flows through the values.

    Args:
        gaussians: of the batch.
        batch: whose photographs and mattes are compared with the renders.
        directions: of the rays of the Gaussians' pixels.
        footprints: size of a pixel at each Gaussian's depth, in the unit of depth.

    Returns:
        Renders from the cameras of the batch,
        and :data:`SLOPES` values of each Gaussian from -1 to 1.
    """
    # Copies: tensors of inference mode can never have a gradient.
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
        wrong = (drawn.image - on_black(batch)).square().sum()
        wrong = wrong + (drawn.alpha - coverage(batch)[:, :, None]).square().sum()
        of_means, of_scales, of_opacities, of_colors = torch.autograd.grad(wrong / 2, leaves)
    with torch.no_grad():
        of_means = of_means * footprints
        along = (of_means * directions).sum(-1, keepdim=True) / directions.norm(dim=-1, keepdim=True)
        inverse = torch.cat((quaternions[:, :1], -quaternions[:, 1:]), -1)
        across = rotate(unit(inverse), of_means)
        logits = of_opacities * opacities * (1 - opacities)
        values = torch.cat((along, across, of_scales * scales, logits[:, None], of_colors), -1)
        parts = (drawn.image.detach(), drawn.alpha.detach(), drawn.depth.detach())
        return Rendering(*parts), torch.tanh(_STEEP * values)


@torch.no_grad()
def observe(gaussians: Gaussians, batch: Batch, rendering: Rendering | None = None) -> Float[Tensor, "N V c"]:
    """:data:`CHANNELS` values of each Gaussian in each view: its own,
    then the others in cyclic order.

    Args:
        gaussians: of the batch, with the pixels that they belong to.
        batch: photographs, masks, mattes and cameras are read.
        rendering: of the Gaussians from these cameras; None: they are rendered.
    """
    with exact(gaussians.means.device.type):
        return _compare(gaussians, batch, rendering or render(gaussians, batch.cameras))


def _compare(gaussians: Gaussians, batch: Batch, rendering: Rendering) -> Float[Tensor, "N V c"]:
    """:func:`observe` by the kernel of the device, if there is one."""
    views = batch.images.shape[1]
    photo = at_least_float32(batch.images)
    mask = coverage(batch)
    cameras = batch.cameras
    seen = (gaussians.means, gaussians.colors, gaussians.image, cameras.intrinsics, cameras.extrinsics)
    maps = (photo, mask, rendering.image, rendering.alpha, rendering.depth)
    if gpu.is_supported(*seen[:2], *seen[3:], *maps):
        return _observe(*seen, *maps, _BEHIND, gaussians.splits)
    if is_supported(gaussians.means, gaussians.colors, photo, cameras.extrinsics):
        values = photo.new_empty(len(gaussians), views, CHANNELS)
        cpu.compare(gaussians, cameras, photo, mask, rendering, _BEHIND, values)
        return values
    return _compared(*seen, *maps, _BEHIND, gaussians.splits)


def _compared(
    means: Float[Tensor, "N 3"],
    colors: Float[Tensor, "N 3"],
    image: Int[Tensor, " N"],
    intrinsics: Float[Tensor, "B V 3 3"],
    extrinsics: Float[Tensor, "B V 4 4"],
    photo: Float[Tensor, "B V 3 H W"],
    mask: Float[Tensor, "B V H W"],
    drawn: Float[Tensor, "B V 3 H W"],
    alpha: Float[Tensor, "B V 1 H W"],
    depth: Float[Tensor, "B V 1 H W"],
    scale: float,
    splits: Sequence[int],
) -> Float[Tensor, "N V c"]:
    """Values of :func:`observe` in plain PyTorch.

    Args:
        means: of the Gaussians, in metres.
        colors: of the Gaussians.
        image: numbers of the images (``b * V + v``) that the Gaussians belong to.
        intrinsics: of the views, in pixels.
        extrinsics: of the views.
        photo: photographs.
        mask: share of each pixel that shows the subject.
        drawn: rendered colours, as are the next two.
        alpha: rendered opacities.
        depth: rendered depths in metres.
        scale: of the distance behind the rendered surface, in metres.
        splits: number of Gaussians of each element."""
    views = photo.shape[1]
    cameras = Cameras(intrinsics, extrinsics, *photo.shape[-2:])
    maps = torch.cat((photo, photo - drawn, mask[:, :, None], alpha, depth), 2)
    seen, z, can_see = _values_at(means, image, splits, cameras, maps)
    color, error, mask, alpha, depth = seen.split((3, 3, 1, 1, 1), -1)
    behind = torch.tanh((z - depth) / scale)
    values = torch.cat((color - colors[:, None], error, mask, alpha, behind), -1)
    values = torch.cat((torch.where(can_see, values, 0), can_see.to(values)), -1)
    own_first = constant(_cyclic, views, like=values, dtype=torch.long)[image % views]
    values = values.gather(1, own_first[..., None].expand_as(values))
    is_own = constant(torch.eye, views, like=values)[0].expand(len(values), -1)
    return torch.cat((values, is_own[..., None]), -1)


_observe = gpu.operator(
    "observe(Tensor means, Tensor colors, Tensor image, Tensor intrinsics, Tensor extrinsics, Tensor photo, "
    "Tensor mask, Tensor drawn, Tensor alpha, Tensor depth, float scale, int[] splits) -> Tensor",
    _compared,
    "ghgs_lit.method.rounds.cuda",
)


def _cyclic(views: int, **kind: object) -> Tensor:
    """The views from each on, in cyclic order: [V, V]."""
    view = torch.arange(views, **kind)
    return (view[:, None] + view) % views


def looked_up(
    gaussians: Gaussians, cameras: Cameras, maps: Float[Tensor, "B V c H W"]
) -> tuple[Float[Tensor, "N V c"], Float[Tensor, "N V 1"], Bool[Tensor, "N V 1"]]:
    """Values of maps at projected means, bilinear; 0 beyond the border.

    Args:
        gaussians: of B elements.
        cameras: [B, V], of the maps.
        maps: of all views.

    Returns:
        Values in each view, z-depths there, and whether the view can see the means: in its frame,
        in front.
    """
    return _values_at(gaussians.means, gaussians.image, gaussians.splits, cameras, maps)


def _values_at(
    means: Tensor, image: Tensor, splits: Sequence[int], cameras: Cameras, maps: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """:func:`looked_up` at means.

    Args:
        means: [N, 3] in the world.
        image: [N], numbers of the images (``b * V + v``) that they belong to, ascending.
        splits: number of means of each element.
        cameras: [B, V], of the maps.
        maps: [B, V, c, H, W].

    Returns:
        As of :func:`looked_up`.
    """
    b, views, channels, height, width = maps.shape
    rows = None
    means = means[None]
    if b > 1:
        # One row of points for each element; those with fewer have points at 0 at the end.
        rows = _rows(image // views, splits)
        means = means.new_zeros(b, max(splits), 3).index_put(rows, means[0])
    means = means[:, None].expand(-1, views, -1, -1)
    pixels, z = project(means, cameras.intrinsics[:, :, None], cameras.extrinsics[:, :, None])
    size = constant(torch.tensor, (width, height), like=pixels)
    # Pixels far outside are clamped: large numbers are not exact.
    grid = (2 / size * pixels - 1).clamp(-3, 3).flatten(0, 1)[:, None]
    sampled = F.grid_sample(maps.flatten(0, 1), grid, align_corners=False)[:, :, 0]
    can_see = (z > 0) & ((pixels >= 0) & (pixels <= size)).all(-1)
    of_image = sampled.view(b, views, channels, -1).permute(0, 3, 1, 2)
    each = (of_image, z.mT[..., None], can_see.mT[..., None])
    return tuple(values[0] if rows is None else values[rows] for values in each)


def _rows(element: Int[Tensor, " N"], splits: Sequence[int]) -> tuple[Tensor, Tensor]:
    """The element of each Gaussian, ascending, and its number among those of the element."""
    first = torch.searchsorted(element, constant(torch.arange, len(splits), like=element))
    return element, torch.arange(len(element), device=element.device) - first[element]
