"""What the photographs say about Gaussians where they are now, without a gradient."""

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from ghgs_lit.geometry.mattes import coverage
from ghgs_lit.geometry.projection import at_least_float32, project
from ghgs_lit.geometry.sampling import sample
from ghgs_lit.rendering import render
from ghgs_lit.types import Batch, Cameras, Gaussians, Rendering

#: Metres behind the rendered surface at which a Gaussian counts as hidden (tanh of the ratio).
_BEHIND = 0.05

#: Values of a Gaussian in a view: photograph minus its own colour (3), photograph minus render (3), mask,
#: alpha, how far it lies behind the rendered surface, whether the view can see it, whether it is from there.
CHANNELS = 11


@torch.no_grad()
def observe(gaussians: Gaussians, batch: Batch) -> Float[Tensor, "N V c"]:
    """What each input view shows of each Gaussian of its element: :data:`CHANNELS` values.

    Args:
        gaussians: with the images that they come from.
        batch: photographs, masks and cameras.
    """
    with torch.autocast(gaussians.means.device.type, enabled=False):
        return _compare(gaussians, batch, render(gaussians, batch.cameras))


def _compare(gaussians: Gaussians, batch: Batch, rendering: Rendering) -> Float[Tensor, "N V c"]:
    views = batch.images.shape[1]
    photo, mask = at_least_float32(batch.images), coverage(batch)[:, :, None]
    maps = (photo, photo - rendering.image, mask, rendering.alpha, rendering.depth)
    found, z, can_see = looked_up(gaussians, batch.cameras, torch.cat(maps, 2))
    color, error, mask, alpha, depth = found.split((3, 3, 1, 1, 1), -1)
    behind = torch.tanh((z - depth) / _BEHIND)
    values = torch.cat((color - gaussians.colors[:, None], error, mask, alpha, behind), -1)
    is_own = F.one_hot(gaussians.image % views, views)[..., None]
    return torch.cat((torch.where(can_see, values, 0), can_see.to(values), is_own.to(values)), -1)


def looked_up(
    gaussians: Gaussians, cameras: Cameras, maps: Float[Tensor, "B V c H W"]
) -> tuple[Float[Tensor, "N V c"], Float[Tensor, "N V 1"], Bool[Tensor, "N V 1"]]:
    """Values of maps where means appear in each view, their z-depths, and whether they lie in the image."""
    views = maps.shape[1]
    element = gaussians.image // views
    means = gaussians.means[:, None].expand(-1, views, -1)
    pixels, z = project(means, cameras.intrinsics[element], cameras.extrinsics[element])
    image = element[:, None] * views + torch.arange(views, device=element.device)
    # A value that is not finite would reach other elements.
    found = sample(maps.flatten(0, 1).nan_to_num(), image, pixels)
    inside = (pixels >= 0).all(-1) & (pixels[..., 0] <= cameras.width) & (pixels[..., 1] <= cameras.height)
    return found, z[..., None], ((z > 0) & inside)[..., None]
