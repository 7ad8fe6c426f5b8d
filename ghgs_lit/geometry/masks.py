"""Masks and soft mattes: extents, patches, distances to outlines, colours, relative depths. A
matte holds the share of a pixel's area that shows the subject. Photographs on black are
premultiplied by it, as renders of Gaussians are (Porter and Duff, SIGGRAPH 1984); a Gaussian needs
the colour of the surface."""

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
    """Index of the first and of the last True along the last axis.

    Args:
        hits: any bools [..., n].

    Returns:
        Both indices [...]; ``n`` and -1 where there is no True.
    """
    count = hits.shape[-1]
    places = constant(_from_both_ends, count, like=hits, dtype=torch.long)
    first, last = (hits[..., None, :] * places).amax(-1).unbind(-1)
    return count - first, last - 1


def _from_both_ends(count: int, **kind: object) -> Int[Tensor, "2 n"]:
    """Numbers of places from 1, counted from the last and from the first."""
    index = torch.arange(1, count + 1, **kind)
    return torch.stack((index.flip(0), index))


def patches_around_subject(
    masks: Bool[Tensor, "b v H W"], patch_size: int, margin: int
) -> Bool[Tensor, "b v h w"]:
    """Patches with a pixel of the subject, and those at most ``margin`` rows and columns away.

    Args:
        masks: [b, v, H, W], whose sides are multiples of the patch size.
        patch_size: side of a patch in pixels.
        margin: in patches, 0 or more.

    Returns:
        Which patches [b, v, h, w].
    """
    return _grown(F.max_pool2d(masks.float(), patch_size), margin)


def patches_in_window(
    masks: Bool[Tensor, "b v H W"], patch_size: int, margin: int
) -> Bool[Tensor, "b v h w"]:
    """Patches of the smallest rectangle around the subject of a view, grown by ``margin``.

    Args:
        masks: [b, v, H, W], whose sides are multiples of the patch size.
        patch_size: side of a patch in pixels.
        margin: in patches, 0 or more.

    Returns:
        Which patches [b, v, h, w]; none of a view with an empty mask.
    """
    touched = F.max_pool2d(masks.float(), patch_size).bool()
    rows = between(touched.any(-1))
    columns = between(touched.any(-2))
    return _grown((rows[..., :, None] & columns[..., None, :]).float(), margin)


def between(hits: Bool[Tensor, "*batch n"]) -> Bool[Tensor, "*batch n"]:
    """True from the first to the last True along the last axis.

    Args:
        hits: any bools [..., n].

    Returns:
        Bools [..., n]; none where there is no True.
    """
    first, last = first_and_last(hits)
    index = constant(torch.arange, hits.shape[-1], like=hits, dtype=torch.long)
    return (index >= first[..., None]) & (index <= last[..., None])


def _grown(patches: Float[Tensor, "b v h w"], margin: int) -> Bool[Tensor, "b v h w"]:
    return F.max_pool2d(patches, 2 * margin + 1, 1, margin).bool()


#: An outline runs through pixels with shares between these.
_RIM = (0.02, 0.98)


def signed_distance(mask: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Signed distance to the outline of a mask, which runs between pixel centres.

    The image's border is no outline.

    Args:
        mask: of the subject [h, w].

    Returns:
        Distances [h, w] in pixels, positive inside; infinite where the mask has no outline.
    """
    from scipy.ndimage import distance_transform_edt  # here: a plain prediction does not need it

    if mask.all() or not mask.any():
        return np.where(mask, np.inf, -np.inf)
    return np.where(mask, distance_transform_edt(mask) - 0.5, 0.5 - distance_transform_edt(~mask))


def soft_signed_distance(matte: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """:func:`signed_distance` with subpixel precision.

    Args:
        matte: shares of pixels that are inside [h, w], in [0, 1].

    Returns:
        Distances [h, w] in pixels, positive inside.
    """
    from scipy.ndimage import distance_transform_edt

    inside = matte > 0.5
    coarse = signed_distance(inside)
    rim = (matte > _RIM[0]) & (matte < _RIM[1])
    if not rim.any():
        return coarse
    away, nearest = distance_transform_edt(~rim, return_indices=True)
    fine = np.where(inside, away, -away) + matte[tuple(nearest)] - 0.5
    # a part of the outline may have no rim
    return np.where(np.abs(fine - coarse) < 0.6, fine, coarse)


def with_matte(batch: Batch, least: float | None) -> Batch:
    """The batch with masks ``matte > least`` if it has a matte.

    Args:
        batch: with or without mattes.
        least: share of a pixel above which it is in the mask, in [0,
            1); None: the matte is dropped.

    Returns:
        The batch; unchanged without a matte.
    """
    if batch.alpha is None:
        return batch
    if least is None:
        return dataclasses.replace(batch, alpha=None)
    return dataclasses.replace(batch, masks=batch.alpha > least)


def coverage(batch: Batch) -> Float[Tensor, "B V H W"]:
    """The share of each pixel that shows the subject: the matte, or else the mask as 0 and 1."""
    shares = batch.masks if batch.alpha is None else batch.alpha
    return shares.to(at_least_float32(batch.images).dtype)


def surface_colors(batch: Batch) -> Float[Tensor, "B V 3 H W"]:
    """Colours of the subject's surface: photographs divided by the matte, at most 1."""
    images = at_least_float32(batch.images)
    return images if batch.alpha is None else unmultiplied(images, batch.alpha.to(images.dtype)[:, :, None])


def unmultiplied(images: Tensor, alpha: Tensor) -> Tensor:
    """Colours divided by ``alpha``, at most 1; unchanged where it is 0.

    Args:
        images: colours that are multiplied by ``alpha``.
        alpha: shares in [0, 1], of a shape that broadcasts with ``images``.

    Returns:
        Colours of the shape of ``images``.
    """
    return torch.where(alpha > 0, (images / torch.where(alpha > 0, alpha, 1)).clamp(max=1), images)


def on_black(batch: Batch) -> Float[Tensor, "B V 3 H W"]:
    """Photographs on black; those with a matte already are."""
    return batch.images if batch.alpha is not None else batch.images * coverage(batch)[:, :, None]


#: Unit of relative depths in metres: about the depth of a body.
UNIT = 0.25

#: Channels of :func:`relative_bounds`.
BOUNDS_CHANNELS = 2


def subject_mean(
    values: Float[Tensor, "B V H W"], masks: Bool[Tensor, "B V H W"]
) -> Float[Tensor, "B V 1 1"]:
    """Mean over the subject's pixels of each view; 0 for an empty mask.

    Args:
        values: maps [B, V, H, W] of any unit.
        masks: of the subject [B, V, H, W].

    Returns:
        Means [B, V, 1, 1].
    """
    count = masks.sum((-2, -1), keepdim=True)
    return torch.where(masks, values, 0).sum((-2, -1), keepdim=True) / count.clamp(min=1)


def relative_bounds(bounds: DepthBounds, masks: Bool[Tensor, "B V H W"]) -> Float[Tensor, "B V 2 H W"]:
    """Two maps of the bounds that describe the shape, not the distance.

    Args:
        bounds: depths in metres.
        masks: of the subject [B, V, H, W].

    Returns:
        ``near`` minus the mean middle of the view's bounds, and ``far - near``, [B, V, 2, H, W] in
        units of :data:`UNIT`; 0 outside the subject.
    """
    middle = subject_mean((bounds.near + bounds.far) / 2, masks)
    maps = torch.stack((bounds.near - middle, bounds.far - bounds.near), dim=2) / UNIT
    return torch.where(masks[:, :, None], maps, 0)


def relative_depth(
    depth: Float[Tensor, "B V H W"], masks: Bool[Tensor, "B V H W"]
) -> Float[Tensor, "B V 1 H W"]:
    """Depth minus its mean over the view's subject, without a gradient.

    Args:
        depth: [B, V, H, W] in metres.
        masks: of the subject [B, V, H, W].

    Returns:
        [B, V, 1, H, W] in units of :data:`UNIT`; 0 outside the masks.
    """
    depth = depth.detach()
    return torch.where(masks, (depth - subject_mean(depth, masks)) / UNIT, 0)[:, :, None]
