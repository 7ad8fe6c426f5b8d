"""Masks and soft mattes: extents, patches, distances to outlines, colours, relative depths.

A matte is the fraction of a pixel's area that shows the subject. Images on black are premultiplied
by it, as renders of Gaussians are (Porter and Duff, SIGGRAPH 1984); the colour of a Gaussian is that
of the surface, without it."""

import dataclasses

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ghgs_lit.geometry.constants import constant
from ghgs_lit.geometry.projection import at_least_float32
from ghgs_lit.types import Batch, DepthBounds


def first_and_last(hits: Bool[Tensor, "*batch n"]) -> tuple[Int[Tensor, "*batch"], Int[Tensor, "*batch"]]:
    """Indices of the first and the last True along the last axis; n and -1 if there is none."""
    count = hits.shape[-1]
    places = constant(_from_both_ends, count, like=hits, dtype=torch.long)
    first, last = (hits[..., None, :] * places).amax(-1).unbind(-1)
    return count - first, last - 1


def _from_both_ends(count: int, **kind: object) -> Int[Tensor, "2 n"]:
    """1-based positions, counted from the last one and from the first one."""
    index = torch.arange(1, count + 1, **kind)
    return torch.stack((index.flip(0), index))


def patches_around_subject(
    masks: Bool[Tensor, "b v H W"], patch_size: int, margin: int
) -> Bool[Tensor, "b v h w"]:
    """Select patches with a pixel of the subject, and those at most ``margin`` rows and columns away.

    Args:
        masks: [b, v, H, W], whose sides are multiples of the patch size.
        patch_size: side of a patch in pixels.
        margin: in patches, 0 or more.

    Returns:
        True for selected patches [b, v, h, w].
    """
    return _grow(F.max_pool2d(masks.float(), patch_size), margin)


def patches_in_window(
    masks: Bool[Tensor, "b v H W"], patch_size: int, margin: int
) -> Bool[Tensor, "b v h w"]:
    """Select the patches of each view's bounding box of the subject, grown by ``margin``.

    Args:
        masks: [b, v, H, W], whose sides are multiples of the patch size.
        patch_size: side of a patch in pixels.
        margin: in patches, 0 or more.

    Returns:
        True for selected patches [b, v, h, w]; none for an empty mask.
    """
    touched = F.max_pool2d(masks.float(), patch_size).bool()
    rows = between(touched.any(-1))
    columns = between(touched.any(-2))
    return _grow((rows[..., :, None] & columns[..., None, :]).float(), margin)


def between(hits: Bool[Tensor, "*batch n"]) -> Bool[Tensor, "*batch n"]:
    """Fill from the first to the last True along the last axis; all False if there is no True."""
    first, last = first_and_last(hits)
    index = constant(torch.arange, hits.shape[-1], like=hits, dtype=torch.long)
    return (index >= first[..., None]) & (index <= last[..., None])


def _grow(patches: Float[Tensor, "b v h w"], margin: int) -> Bool[Tensor, "b v h w"]:
    return F.max_pool2d(patches, 2 * margin + 1, 1, margin).bool()


#: Pixels with a matte between these lie on an outline.
_RIM = (0.02, 0.98)


def signed_distance(mask: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Signed distance of pixel centres to the outline of a mask, in pixels, positive inside.

    The outline runs halfway between pixel centres; the image's border is not part of it. Distances
    are infinite if the mask has no outline.
    """
    from scipy.ndimage import distance_transform_edt  # imported late: predictions do not need it

    if mask.all() or not mask.any():
        return np.where(mask, np.inf, -np.inf)
    return np.where(mask, distance_transform_edt(mask) - 0.5, 0.5 - distance_transform_edt(~mask))


def soft_signed_distance(matte: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """:func:`signed_distance` with subpixel precision, from a matte in [0, 1]."""
    from scipy.ndimage import distance_transform_edt

    inside = matte > 0.5
    coarse = signed_distance(inside)
    rim = (matte > _RIM[0]) & (matte < _RIM[1])
    if not rim.any():
        return coarse
    away, nearest = distance_transform_edt(~rim, return_indices=True)
    fine = np.where(inside, away, -away) + matte[tuple(nearest)] - 0.5
    # Parts of the outline may have no pixel with a fractional matte.
    return np.where(np.abs(fine - coarse) < 0.6, fine, coarse)


def with_matte(batch: Batch, least: float | None) -> Batch:
    """Replace the masks of a batch by ``matte > least``; a batch without mattes is unchanged.

    Args:
        batch: with or without mattes.
        least: matte above which a pixel is in the mask, in [0, 1); None: keep the masks and drop
            the matte.
    """
    if batch.alpha is None:
        return batch
    if least is None:
        return dataclasses.replace(batch, alpha=None)
    return dataclasses.replace(batch, masks=batch.alpha > least)


def coverage(batch: Batch) -> Float[Tensor, "B V H W"]:
    """Fraction of each pixel that shows the subject: the matte, or the mask as 0 and 1."""
    shares = batch.masks if batch.alpha is None else batch.alpha
    return shares.to(at_least_float32(batch.images).dtype)


def surface_colors(batch: Batch) -> Float[Tensor, "B V 3 H W"]:
    """Colours of the subject's surface: input images divided by the matte, at most 1."""
    images = at_least_float32(batch.images)
    return images if batch.alpha is None else unmultiply(images, batch.alpha.to(images.dtype)[:, :, None])


def unmultiply(images: Tensor, alpha: Tensor) -> Tensor:
    """Divide premultiplied colours by ``alpha``: at most 1, unchanged where ``alpha`` is 0.

    Args:
        images: colours multiplied by ``alpha``.
        alpha: in [0, 1], of a shape that broadcasts with ``images``.
    """
    return torch.where(alpha > 0, (images / torch.where(alpha > 0, alpha, 1)).clamp(max=1), images)


def on_black(batch: Batch) -> Float[Tensor, "B V 3 H W"]:
    """Input images on black; those with a matte already are."""
    return batch.images if batch.alpha is not None else batch.images * coverage(batch)[:, :, None]


#: Unit of relative depths in metres: about the depth of a body.
UNIT = 0.25

#: Channels of :func:`relative_bounds`.
BOUNDS_CHANNELS = 2


def subject_mean(
    values: Float[Tensor, "B V H W"], masks: Bool[Tensor, "B V H W"]
) -> Float[Tensor, "B V 1 1"]:
    """Mean over the subject's pixels of each view; 0 for an empty mask."""
    count = masks.sum((-2, -1), keepdim=True)
    return torch.where(masks, values, 0).sum((-2, -1), keepdim=True) / count.clamp(min=1)


def relative_bounds(bounds: DepthBounds, masks: Bool[Tensor, "B V H W"]) -> Float[Tensor, "B V 2 H W"]:
    """Depth bounds as two maps that depend on the subject's shape but not on its distance.

    Args:
        bounds: depths in metres.
        masks: of the subject [B, V, H, W].

    Returns:
        ``near`` minus the mean of the view's ``(near + far) / 2``, and ``far - near``,
        [B, V, 2, H, W] in units of :data:`UNIT`; 0 outside the subject.
    """
    middle = subject_mean((bounds.near + bounds.far) / 2, masks)
    maps = torch.stack((bounds.near - middle, bounds.far - bounds.near), dim=2) / UNIT
    return torch.where(masks[:, :, None], maps, 0)


def relative_depth(
    depth: Float[Tensor, "B V H W"], masks: Bool[Tensor, "B V H W"]
) -> Float[Tensor, "B V 1 H W"]:
    """Depth minus its mean over the subject of the view, detached.

    Args:
        depth: [B, V, H, W] in metres.
        masks: of the subject [B, V, H, W].

    Returns:
        [B, V, 1, H, W] in units of :data:`UNIT`; 0 outside the masks.
    """
    depth = depth.detach()
    return torch.where(masks, (depth - subject_mean(depth, masks)) / UNIT, 0)[:, :, None]
