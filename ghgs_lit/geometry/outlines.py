"""Distances to the outlines of masks."""

import numpy as np
from jaxtyping import Bool, Float


def signed_distance(mask: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Pixels to the outline, which runs between pixel centres: above 0 inside, below 0 outside.

    The image's border is no outline: a mask without one is infinitely far from it.
    """
    from scipy.ndimage import distance_transform_edt  # here: a plain prediction does not need it

    if mask.all() or not mask.any():
        return np.where(mask, np.inf, -np.inf)
    return np.where(mask, distance_transform_edt(mask) - 0.5, 0.5 - distance_transform_edt(~mask))
