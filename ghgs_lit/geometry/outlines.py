"""Distances to the outlines of masks."""

import numpy as np
from jaxtyping import Bool, Float

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
