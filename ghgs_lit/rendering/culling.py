"""Remove Gaussians before rendering: those that no camera sees, and faint or tiny ones with a known error."""

import dataclasses
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ghgs_lit.errors import require
from ghgs_lit.rendering import reference
from ghgs_lit.rendering.api import render
from ghgs_lit.rendering.settings import RasterSettings
from ghgs_lit.types import Cameras, Gaussians

# Margin in pixels around a splat's box; rounding moves the box by less.
_SLACK = 1.0


@dataclass(frozen=True)
class Culled:
    """The Gaussians that are kept, their mask, and a bound of the error of each pixel.

    ``bound`` is the alpha ``1 - prod(1 - alpha_i)`` of the removed Gaussians drawn alone, 0 where none of
    them is seen. No alpha of the image changes by more than ``bound``, and no colour by more than ``bound``
    times the range of the colours (background included), in pixels that do not end early (``stop``).
    """

    gaussians: Gaussians
    kept: Bool[Tensor, " N"]
    bound: Float[Tensor, "B T 1 h w"]


@torch.no_grad()
def cull(
    gaussians: Gaussians,
    cameras: Cameras,
    opacity: float = 0.0,
    size: float = 0.0,
    near: float = 0.01,
    far: float = 1e10,
    settings: RasterSettings | None = None,
) -> Culled:
    """Remove Gaussians that no camera of their batch element sees, and optionally faint and tiny ones.

    By default only Gaussians that cannot change a bit of ``render`` are removed: nearer than ``near``, beyond
    ``far``, outside every frame, or with an opacity below ``alpha_min``. The kept ones keep their gradients.

    Args:
        gaussians: of ``B`` elements.
        cameras: [B, T].
        opacity: remove Gaussians with a smaller opacity as well.
        size: remove Gaussians whose larger standard deviation on the image, before the low-pass filter, is
            less than this number of pixels in all views as well.
        near, far, settings: as for :func:`~ghgs_lit.rendering.render`.
    """
    settings = settings or RasterSettings()
    require(0 <= opacity <= 1, "cull.opacity", "a number from 0 to 1", opacity)
    require(size >= 0, "cull.size", "pixels, at least 0", size)
    seen, small = [], []
    for element in range(len(gaussians.splits)):
        some = gaussians[element].to(torch.float64)
        views = [_seen(some, cameras[element, view], near, far, settings) for view in range(cameras.shape[1])]
        none = torch.zeros(len(some), dtype=torch.bool, device=some.means.device)
        seen.append(torch.stack([none, *(found for found, _ in views)]).any(0))
        widest = torch.stack([torch.zeros_like(some.opacities), *(width for _, width in views)]).amax(0)
        small.append((widest < size) | (some.opacities < opacity))
    none = gaussians.means.new_zeros(0, dtype=torch.bool)
    seen, small = torch.cat([*seen, none]), torch.cat([*small, none])
    dropped = _subset(gaussians, seen & small)
    without_stop = dataclasses.replace(settings, stop=0.0)
    bound = render(dropped, cameras, near=near, far=far, settings=without_stop).alpha
    kept = seen & ~small
    with torch.enable_grad():
        return Culled(_subset(gaussians, kept), kept, bound)


def _seen(gaussians: Gaussians, camera: Cameras, near: float, far: float, settings: RasterSettings):
    """Which Gaussians may reach a pixel of one camera, and their larger standard deviation in pixels."""
    splats = reference.project(gaussians, camera.to(torch.float64), settings)
    xx, xy, yy = splats.covariances.unbind(-1)
    x, y = splats.centers.unbind(-1)
    z, slack = splats.depths, 1e-6
    seen = (z >= near * (1 - slack)) & (z <= far * (1 + slack))
    seen &= splats.opacities >= settings.alpha_min * (1 - slack)
    reach_x, reach_y = settings.extent * xx.sqrt() + _SLACK, settings.extent * yy.sqrt() + _SLACK
    seen &= (x > -reach_x) & (x < camera.width + reach_x) & (y > -reach_y) & (y < camera.height + reach_y)
    middle, half = 0.5 * (xx + yy) - settings.low_pass, torch.hypot(0.5 * (xx - yy), xy)
    return seen, torch.where(seen, (middle + half).clamp_min(0).sqrt(), 0)


def _subset(gaussians: Gaussians, where: Bool[Tensor, " N"]) -> Gaussians:
    splits = tuple(int(part.sum()) for part in where.split(gaussians.splits))
    return gaussians.select(where, splits)
