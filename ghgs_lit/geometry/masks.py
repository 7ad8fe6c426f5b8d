"""Where a mask begins and ends, the patches that it touches, and distances to its outline."""

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor


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
