"""What masks say: where they begin and end, patches, distances to outlines, mattes, depths relative to them.

Soft mattes show the subject in a part of a pixel's area. Photographs on black are premultiplied by that part,
as renders of Gaussians are (Porter and Duff, SIGGRAPH 1984); a Gaussian needs the colour of the surface.
"""

import dataclasses

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ghgs_lit.geometry.projection import at_least_float32
from ghgs_lit.types import Batch, DepthBounds


def first_and_last(hits: Bool[Tensor, "*batch n"]) -> tuple[Int[Tensor, "*batch"], Int[Tensor, "*batch"]]:
    """Index of the first and of the last True along the last axis; ``n`` and -1 where there is none."""
    count = hits.shape[-1]
    index = torch.arange(count, device=hits.device)
    return torch.where(hits, index, count).amin(-1), torch.where(hits, index, -1).amax(-1)


def patches_around_subject(
    masks: Bool[Tensor, "b v H W"], patch_size: int, margin: int
) -> Bool[Tensor, "b v h w"]:
    """Patches with a pixel of the subject, and those at most ``margin`` rows and columns from one of them.
    ``masks``: of the photographs; sides are multiples of the patch size."""
    return _grown(F.max_pool2d(masks.float(), patch_size), margin)


def patches_in_window(
    masks: Bool[Tensor, "b v H W"], patch_size: int, margin: int
) -> Bool[Tensor, "b v h w"]:
    """Patches of the smallest rectangle that holds the subject of a view, and of ``margin`` rows and columns
    around it; arguments as of :func:`patches_around_subject`. A view with an empty mask has none."""
    touched = F.max_pool2d(masks.float(), patch_size).bool()
    rows, columns = between(touched.any(-1)), between(touched.any(-2))
    return _grown((rows[..., :, None] & columns[..., None, :]).float(), margin)


def between(hits: Bool[Tensor, "*batch n"]) -> Bool[Tensor, "*batch n"]:
    """From the first to the last True along the last axis; none where there is none."""
    first, last = first_and_last(hits)
    index = torch.arange(hits.shape[-1], device=hits.device)
    return (index >= first[..., None]) & (index <= last[..., None])


def _grown(patches: Float[Tensor, "b v h w"], margin: int) -> Bool[Tensor, "b v h w"]:
    return F.max_pool2d(patches, 2 * margin + 1, 1, margin).bool()


#: Shares of a pixel between which an outline runs through it.
_RIM = (0.02, 0.98)


def signed_distance(mask: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Pixels to the outline, which runs between pixel centres: above 0 inside, below 0 outside.

    The image's border is no outline: a mask without one is infinitely far from it.
    """
    from scipy.ndimage import distance_transform_edt  # here: a plain prediction does not need it

    if mask.all() or not mask.any():
        return np.where(mask, np.inf, -np.inf)
    return np.where(mask, distance_transform_edt(mask) - 0.5, 0.5 - distance_transform_edt(~mask))


def soft_signed_distance(matte: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """:func:`signed_distance` to fractions of a pixel: its share that is inside says where outlines are."""
    from scipy.ndimage import distance_transform_edt

    inside = matte > 0.5
    coarse, rim = signed_distance(inside), (matte > _RIM[0]) & (matte < _RIM[1])
    if not rim.any():
        return coarse
    away, nearest = distance_transform_edt(~rim, return_indices=True)
    fine = np.where(inside, away, -away) + matte[tuple(nearest)] - 0.5
    return np.where(np.abs(fine - coarse) < 0.6, fine, coarse)  # a part of the outline may have no rim


def with_matte(batch: Batch, least: float | None) -> Batch:
    """The batch whose masks hold all pixels that show more of the subject than ``least``. ``batch``: as it is
    where it has no matte. ``least``: a share; None: the batch without its matte."""
    if batch.alpha is None:
        return batch
    if least is None:
        return dataclasses.replace(batch, alpha=None)
    return dataclasses.replace(batch, masks=batch.alpha > least)


def coverage(batch: Batch) -> Float[Tensor, "B V H W"]:
    """The share of each pixel that shows the subject: 0 or 1 by the mask where there is no matte."""
    shares = batch.masks if batch.alpha is None else batch.alpha
    return shares.to(at_least_float32(batch.images).dtype)


def surface_colors(batch: Batch) -> Float[Tensor, "B V 3 H W"]:
    """Photographs divided by the matte, at most 1: the colour of what a pixel shows of the subject."""
    images = at_least_float32(batch.images)
    return images if batch.alpha is None else unmultiplied(images, batch.alpha.to(images.dtype)[:, :, None])


def unmultiplied(images: Tensor, alpha: Tensor) -> Tensor:
    """Colours divided by ``alpha``, at most 1; as they are where it is 0 and says nothing of them."""
    return torch.where(alpha > 0, (images / torch.where(alpha > 0, alpha, 1)).clamp(max=1), images)


def on_black(batch: Batch) -> Float[Tensor, "B V 3 H W"]:
    """Photographs without what is beside the subject; with a matte they are on black already."""
    return batch.images if batch.alpha is not None else batch.images * coverage(batch)[:, :, None]


#: Metres that become 1: about the depth of a body.
UNIT = 0.25

#: Channels of :func:`relative_bounds`.
BOUNDS_CHANNELS = 2


def subject_mean(
    values: Float[Tensor, "B V H W"], masks: Bool[Tensor, "B V H W"]
) -> Float[Tensor, "B V 1 1"]:
    """Mean over the subject's pixels of each view; 0 for a view without any."""
    count = masks.sum((-2, -1), keepdim=True)
    return torch.where(masks, values, 0).sum((-2, -1), keepdim=True) / count.clamp(min=1)


def relative_bounds(bounds: DepthBounds, masks: Bool[Tensor, "B V H W"]) -> Float[Tensor, "B V 2 H W"]:
    """The bounds as two maps: what masks and cameras say about the shape, not about the distance. ``bounds``:
    near and far in metres. Returns: ``near`` minus the mean middle of the view's bounds, and ``far - near``,
    in units of :data:`UNIT`; 0 outside the subject."""
    middle = subject_mean((bounds.near + bounds.far) / 2, masks)
    maps = torch.stack((bounds.near - middle, bounds.far - bounds.near), dim=2) / UNIT
    return torch.where(masks[:, :, None], maps, 0)


def relative_depth(
    depth: Float[Tensor, "B V H W"], masks: Bool[Tensor, "B V H W"]
) -> Float[Tensor, "B V 1 H W"]:
    """Depth minus its mean over the view's subject, in units of :data:`UNIT`, without a gradient. ``depth``:
    in metres. ``masks``: of the subject; the map is 0 outside."""
    depth = depth.detach()
    return torch.where(masks, (depth - subject_mean(depth, masks)) / UNIT, 0)[:, :, None]
