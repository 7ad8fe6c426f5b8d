"""Baselines: alternatives to a trained model, and simple methods that a model must beat."""

from collections.abc import Callable
from functools import partial

import torch
import torch.nn.functional as F
from torch import Tensor

from ghgs_lit.errors import InputError, require_choice
from ghgs_lit.evaluation.measure import Estimate, Method, Renderer
from ghgs_lit.geometry.masks import coverage, surface_colors, with_matte
from ghgs_lit.geometry.projection import focal_lengths, unproject_maps
from ghgs_lit.geometry.rotations import rotate
from ghgs_lit.method.bounds import VisualHull
from ghgs_lit.ops.activation import surface_axes
from ghgs_lit.ops.photo_consistency import photo_consistency
from ghgs_lit.refinement import Change, Refinement
from ghgs_lit.types import Batch, DepthBounds, DepthMaps, Gaussians

#: Finer and tighter than a model's bounds, which must contain the subject despite bad masks.
HULL = VisualHull(dilation=0.005, samples=192)


def hull_bounds(batch: Batch) -> DepthBounds:
    """Depths at which each pixel's ray enters and leaves the visual hull.

    Args:
        batch: Masks and cameras are read.

    Returns:
        Near and far [B, V, H, W], metres.
    """
    return HULL(batch)


def hull_depth(batch: Batch) -> Tensor:
    """Depth of the front surface of the visual hull.

    Splats at these depths resemble the image-based visual hull (Matusik et al. 2000).

    Args:
        batch: Masks and cameras are read.

    Returns:
        Depths [B, V, H, W], metres; 0 outside the subject.
    """
    return batch.once(hull_bounds).near * batch.masks


#: Number of swept depths; half the side of the window over which consistency is averaged, as a
#: share of the image's longer side; temperature of the softmax over depths. Tuned on four people
#: with 3 to 5 views.
DEPTHS = 32
WINDOW = 0.02
SOFTNESS = 0.03


def photo_depth(batch: Batch) -> Tensor:
    """Depths of a plane sweep between the front and back surfaces of the visual hull.

    Each is the mean of the swept depths, weighted by the softmax of their photo-consistency in a
    window (soft argmin of Kendall et al., ICCV 2017). It is the middle of the hull where all depths
    are equally consistent.

    Args:
        batch: Images, masks and cameras are read.

    Returns:
        Depths [B, V, H, W], metres; 0 outside the subject.
    """
    bounds = batch.once(hull_bounds)
    consistency = photo_consistency(batch, bounds, DEPTHS)
    radius = max(round(WINDOW * max(batch.masks.shape[-2:])), 1)
    weights = (_average_in_window(consistency, batch.masks, radius) / SOFTNESS).softmax(2)
    shares = (torch.arange(DEPTHS, device=weights.device, dtype=weights.dtype) + 0.5) / DEPTHS
    share = torch.einsum("bvshw,s->bvhw", weights, shares)
    return (bounds.near + (bounds.far - bounds.near) * share) * batch.masks


def _average_in_window(values: Tensor, masks: Tensor, radius: int) -> Tensor:
    """Average ``values`` [B, V, S, H, W] over the subject's pixels in a window around each pixel."""
    inside = masks.to(values.dtype)
    counts = _window_mean(inside, radius)
    sums = _window_mean((values * inside[:, :, None]).flatten(1, 2), radius).view_as(values)
    return sums / torch.where(counts > 0, counts, 1.0)[:, :, None]


def _window_mean(maps: Tensor, radius: int) -> Tensor:
    """Means [B, n, H, W] over a square window; maps are 0 outside the image."""
    side = 2 * radius + 1
    maps = F.avg_pool2d(maps, (side, 1), 1, (radius, 0))
    return F.avg_pool2d(maps, (1, side), 1, (0, radius))


#: Discs like the initial ones of ``model=recurrent``: standard deviations along and across the
#: surface and distance behind it, in pixel footprints; opacity; low-pass filter in px^2.
_ALONG = 0.5
_ACROSS = 0.1
_INWARD = 0.4
_OPACITY = 0.8
_LOW_PASS = 0.1
#: Matte above which a pixel gets a disc.
_MATTE = 0.125


def splats_at(
    batch: Batch, depth: Tensor, valid: Tensor, sigma: float = 0.3, opacity: float = 0.9
) -> Gaussians:
    """Isotropic Gaussians at the unprojected pixels.

    Args:
        batch: Colours and cameras are read.
        depth: Depths [B, V, H, W], metres.
        valid: Pixels [B, V, H, W] that get a Gaussian.
        sigma: Standard deviation in pixels of the input views.
        opacity: Opacity of all Gaussians, in (0, 1).

    Returns:
        Gaussians in the order of the valid pixels.
    """
    points = unproject_maps(depth, batch.cameras)[valid]
    focal = batch.cameras.intrinsics.diagonal(dim1=-2, dim2=-1)[..., :2].mean(-1)
    scale = (sigma * depth / focal[..., None, None])[valid]
    image, pixel = valid.flatten(0, 1).flatten(1).nonzero().unbind(1)
    return Gaussians(
        means=points,
        quaternions=points.new_tensor([1.0, 0.0, 0.0, 0.0]).expand(len(points), 4),
        scales=scale[:, None].expand(-1, 3),
        opacities=torch.full_like(scale, opacity),
        colors=batch.once(surface_colors).movedim(2, -1)[valid],
        splits=tuple(valid.flatten(1).sum(1).tolist()),
        image=image,
        pixel=pixel,
    )


def discs_at(batch: Batch, depth: Tensor, valid: Tensor) -> Gaussians:
    """Discs on the surface of depth maps, like the initial Gaussians of heads with ``axes=surface``.

    Args:
        batch: Colours, mattes and cameras are read.
        depth: Depths [B, V, H, W], metres.
        valid: Pixels [B, V, H, W] that get a disc.

    Returns:
        Gaussians in the order of the valid pixels.
    """
    image, pixel = valid.flatten(0, 1).flatten(1).nonzero().unbind(1)
    focal = focal_lengths(batch.cameras).prod(-1).sqrt()
    footprint = (depth / focal[..., None, None])[valid][:, None]
    axes = surface_axes(DepthMaps(depth, valid, valid.to(depth)), batch.cameras, image, pixel)
    inward = rotate(axes, footprint * footprint.new_tensor([0.0, 0.0, _INWARD]))
    return Gaussians(
        means=unproject_maps(depth, batch.cameras)[valid] + inward,
        quaternions=axes,
        scales=footprint * footprint.new_tensor([_ALONG, _ALONG, _ACROSS]),
        opacities=_OPACITY * coverage(batch)[valid],
        colors=batch.once(surface_colors).movedim(2, -1)[valid],
        splits=tuple(valid.flatten(1).sum(1).tolist()),
        image=image,
        pixel=pixel,
        low_pass=_LOW_PASS,
        antialiased=True,
    )


def true_depth(batch: Batch) -> Tensor:
    """Ground-truth depth maps of the data.

    Returns:
        Depths [B, V, H, W], metres.

    Raises:
        InputError: The data has no depth maps.
    """
    if batch.depths is None:
        raise InputError("baselines: true_depth expects depth maps in the data; found none")
    return batch.depths


def render_discs(batch: Batch, depth_of: Callable[[Batch], Tensor], renderer: Renderer) -> Estimate:
    """Render discs at given depths; where the batch has mattes, also at pixels of the rim.

    Args:
        batch: With targets.
        depth_of: Computes depths [B, V, H, W] of a batch, metres; 0: no disc.
        renderer: Renders the discs from the target cameras.

    Returns:
        Renders, depths and discs.
    """
    batch = with_matte(batch, _MATTE)
    depth = depth_of(batch)
    valid = batch.masks & (depth > 0)
    gaussians = discs_at(batch, depth, valid)
    image = renderer(gaussians, batch.targets.cameras).image
    return Estimate(image, depth, valid, gaussians)


#: Limits and rates of the fitted attributes, tuned for novel views on four people with 3 to 5
#: views. A limit of 0.1 or more for colours costs 0.2 to 1 dB in novel views.
CHANGES = {
    "means": Change(limit=30.0, rate=0.5),
    "quaternions": Change(limit=1.0, rate=0.05),
    "scales": Change(limit=2.0, rate=0.02),
    "opacities": Change(limit=7.0, rate=0.1),
    "colors": Change(limit=0.05, rate=0.001),
}
#: Weights of L1 and 1 - SSIM as in 3D Gaussian splatting, and of L1 of the silhouette.
_WEIGHTS = (0.8, 0.2, 0.1)


def start_scene(batch: Batch) -> Gaussians:
    """Initial Gaussians of ``per_scene``: isotropic ones for each pixel of the subject, at
    :func:`photo_depth`."""
    depth = photo_depth(batch)
    return splats_at(batch, depth, depth > 0, sigma=0.5, opacity=0.5)


def per_scene(batch: Batch, renderer: Renderer, steps: int) -> Estimate:
    """Per-scene 3D Gaussian splatting (Kerbl et al. 2023), fitted to the input views.

    None is added or pruned: one Gaussian for each pixel of the subject in each input view is more than
    the views determine.

    Args:
        batch: Images, masks and cameras are read.
        renderer: Renders input and target views.
        steps: Steps of the optimiser, at least 1.
    """
    gaussians = Refinement(steps, renderer, CHANGES, _WEIGHTS)(start_scene(batch), batch)
    return Estimate(renderer(gaussians, batch.targets.cameras).image, gaussians=gaussians)


def nearest_view(batch: Batch) -> Estimate:
    """Predict each target as the input view with the nearest viewing direction.

    Args:
        batch: With images [B, V, 3, H, W] and T targets of h x w pixels.

    Returns:
        Input views [B, T, 3, h, w], resized to the size of the targets.
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


#: Baselines that render discs, with the function of their depths.
DEPTH_OF = {
    "hull": hull_depth,
    "photo_depth": photo_depth,
    "true_depth": true_depth,
}
BASELINES = ("nearest_view", *DEPTH_OF, "per_scene")


def baseline(name: str, renderer: Renderer, steps: int) -> Method:
    """Build a baseline.

    Args:
        name: One of ``BASELINES``.
        renderer: Renders Gaussians from the target cameras.
        steps: Steps of the optimiser of ``per_scene``, at least 1.

    Raises:
        InputError: There is no such baseline.
    """
    require_choice("baselines", name, BASELINES)
    if name == "per_scene":
        return partial(per_scene, renderer=renderer, steps=steps)
    if name == "nearest_view":
        return nearest_view
    return partial(render_discs, depth_of=DEPTH_OF[name], renderer=renderer)
