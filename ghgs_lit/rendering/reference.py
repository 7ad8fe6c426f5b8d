"""Reference renderer in plain PyTorch, in the dtype of its input, with gradients by autograd.

Evaluates every Gaussian at every pixel, so it is slow and needs much memory: for tests.
:class:`ghgs_lit.ops.rasterization.settings.RasterSettings` defines the image."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ghgs_lit.geometry.projection import pixel_centers
from ghgs_lit.geometry.rotations import quaternion_to_matrix
from ghgs_lit.ops.rasterization.layout import ALPHA_MIN, EXTENT, FRUSTUM_MARGIN, STOP
from ghgs_lit.ops.rasterization.settings import RasterSettings
from ghgs_lit.types import Cameras, Gaussians, Rendering

# Largest number of Gaussians times pixels in memory at once.
_CHUNK = 1 << 19


@dataclass(frozen=True)
class Splats:
    """Gaussians projected into one camera: centres in pixels, covariances (xx, xy, yy) in px^2."""

    centers: Float[Tensor, "n 2"]
    covariances: Float[Tensor, "n 3"]
    determinants: Float[Tensor, " n"]
    depths: Float[Tensor, " n"]
    opacities: Float[Tensor, " n"]
    colors: Float[Tensor, "n 3"]


def rasterize(gaussians: Gaussians, cameras: Cameras, settings: RasterSettings, near: float) -> Rendering:
    """Render on black; see :func:`ghgs_lit.rendering.render`.

    Args:
        gaussians: of B elements, in float32 or float64.
        cameras: [B, T], in the dtype of the means.
        settings: constants of the image.
        near: near plane, in the unit of the means.

    Returns:
        Image [B, T, 3, h, w], alpha and expected depth [B, T, 1, h, w], in the dtype of the means;
        differentiable in Gaussians and cameras.
    """
    each = []
    for element in range(cameras.shape[0]):
        for view in range(cameras.shape[1]):
            each.append(_view(gaussians[element], cameras[element, view], settings, near))
    empty = gaussians.means.new_zeros(0, 5, cameras.height, cameras.width)
    sums = torch.stack(each) if each else empty
    image, depth, alpha = sums.unflatten(0, cameras.shape).split((3, 1, 1), dim=2)
    return Rendering(image=image, alpha=alpha, depth=depth / alpha.clamp_min(1e-10))


def _view(
    gaussians: Gaussians, camera: Cameras, settings: RasterSettings, near: float
) -> Float[Tensor, "5 h w"]:
    """Sums over the Gaussians visible in each pixel of ``w colour`` (3 channels), ``w z`` and ``w``, for
    one element and one camera without batch dimensions."""
    index = visible(gaussians, camera, settings, near)
    splats = project(gaussians.select(index, (len(index),)), camera, settings)
    centers = pixel_centers(camera.height, camera.width, splats.centers).flatten(0, 1)
    step = max(1, _CHUNK // max(1, len(splats.depths)))
    image = torch.cat([_blend(splats, chunk, settings) for chunk in centers.split(step)])
    return image.mT.unflatten(1, (camera.height, camera.width))


@torch.no_grad()
def visible(
    gaussians: Gaussians, camera: Cameras, settings: RasterSettings, near: float
) -> Int[Tensor, " n"]:
    """Indices of the visible Gaussians, sorted by float32 depth, ties by index.

    A Gaussian is visible if its centre is finite and not nearer than ``near``, its determinant positive
    and finite, and its opacity at least ``ALPHA_MIN``.

    Args:
        gaussians: of one element.
        camera: one camera, without batch dimensions.
        settings: constants of the image.
        near: near plane, in the unit of the means.
    """
    splats = project(gaussians, camera, settings)
    depths = splats.depths
    determinants = splats.determinants
    keep = (depths >= near) & (depths <= 1e10) & (determinants > 0) & determinants.isfinite()
    keep &= (splats.opacities >= ALPHA_MIN) & splats.centers.isfinite().all(-1)
    index = keep.nonzero()[:, 0]
    return index[depths[index].float().argsort(stable=True)]


def project(gaussians: Gaussians, camera: Cameras, settings: RasterSettings) -> Splats:
    """Project all n Gaussians of an element into one camera, visible or not.

    The covariance is that of EWA splatting (Zwicker et al., 2001), ``J W Sigma W^T J^T`` plus
    ``low_pass`` on its diagonal, with the Jacobian J at the centre, clamped to the frame plus
    ``FRUSTUM_MARGIN``.
    """
    rotation = camera.extrinsics[:3, :3]
    translation = camera.extrinsics[:3, 3]
    points = gaussians.means @ rotation.mT + translation
    x, y, z = points.unbind(-1)
    focal = camera.intrinsics.diagonal()[:2]
    center = camera.intrinsics[:2, 2]
    size = focal.new_tensor([camera.width, camera.height])
    margin = FRUSTUM_MARGIN * 0.5 * size / focal
    tangents = torch.stack((x / z, y / z), dim=-1)
    low = -center / focal - margin
    high = (size - center) / focal + margin
    tangents = torch.minimum(torch.maximum(tangents, low), high)
    zero = torch.zeros_like(z)
    across = torch.stack((focal[0] / z, zero, -focal[0] / z * tangents[:, 0]), dim=-1)
    down = torch.stack((zero, focal[1] / z, -focal[1] / z * tangents[:, 1]), dim=-1)
    jacobian = torch.stack((across, down), dim=-2)
    root = quaternion_to_matrix(gaussians.quaternions) * gaussians.scales[:, None, :]
    row_x, row_y = (jacobian @ rotation @ root).unbind(-2)
    xx = (row_x * row_x).sum(-1)
    xy = (row_x * row_y).sum(-1)
    yy = (row_y * row_y).sum(-1)
    # |row_x x row_y|^2 = xx yy - xy^2 without cancellation.
    bare = torch.linalg.cross(row_x, row_y).square().sum(-1)
    determinant = bare + settings.low_pass * (xx + yy) + settings.low_pass**2
    opacities = gaussians.opacities
    if settings.antialiased:
        ratio = bare / determinant
        is_flat = ~(ratio > 0)
        opacities = opacities * torch.where(is_flat, zero, torch.where(is_flat, 1, ratio).sqrt())
    centers = focal * points[:, :2] / z[:, None] + center
    covariances = torch.stack((xx + settings.low_pass, xy, yy + settings.low_pass), dim=-1)
    return Splats(centers, covariances, determinant, z, opacities, gaussians.colors)


def _blend(splats: Splats, pixels: Float[Tensor, "P 2"], settings: RasterSettings) -> Float[Tensor, "P c"]:
    """Composite splats, sorted front to back, at P pixel centres; returns the sums of :func:`_view`."""
    dx, dy = (pixels[None] - splats.centers[:, None]).unbind(-1)
    xx, xy, _ = splats.covariances[:, None].unbind(-1)
    sigma = 0.5 * (dx * dx / xx + (dy - xy / xx * dx).square() * xx / splats.determinants[:, None])
    near_enough = sigma <= 0.5 * EXTENT**2
    raw = splats.opacities[:, None] * torch.exp(-torch.where(near_enough, sigma, 0))
    # A clamped alpha has no gradient, not even at equality.
    alpha = torch.where(raw < settings.alpha_max, raw, settings.alpha_max)
    hit = near_enough & (alpha >= ALPHA_MIN)
    behind = torch.log1p(-torch.where(hit, alpha, 0)).cumsum(0)
    # Transmittance only decreases, so all splats after the first skipped one are skipped, too.
    seen = hit & (behind > (math.log(STOP) if STOP > 0 else -math.inf))
    alpha = torch.where(seen, alpha, 0)
    step = torch.log1p(-alpha)
    weights = alpha * torch.exp(step.cumsum(0) - step)
    ones = torch.ones_like(splats.depths)
    values = torch.cat((splats.colors, splats.depths[:, None], ones[:, None]), dim=-1)
    # Not a matrix product: colours that are not finite must not reach pixels outside their splat.
    return (weights[..., None] * torch.where(seen[..., None], values[:, None], 0)).sum(0)
