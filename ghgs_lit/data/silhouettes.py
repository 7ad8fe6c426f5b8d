"""Checks of a person's masks that need no body: each by itself, and each beside the others."""

from collections.abc import Mapping, Sequence

import numpy as np

from ghgs_lit.data.resampling import area_mask
from ghgs_lit.data.view import View
from ghgs_lit.geometry.silhouettes import HullSearch, Silhouette, subject_sphere

# Side of a mask in cells, at most.
_CELLS = 64
#: Of many photographs: a quarter of the other masks may be wrong.
SEARCH = HullSearch(rays=200, depths=64, reach=1.0, others=12, wrong=0.25)
# A person covers more of a photograph than this, and less of its border than that.
_LEAST_SHARE, _MOST_BORDER = 1e-3, 0.5


def silhouette(view: View) -> Silhouette:
    """The coarse silhouette of a photograph."""
    height, width = view.mask.shape
    scale = min(_CELLS / max(height, width), 1)
    size = max(round(height * scale), 1), max(round(width * scale), 1)
    intrinsics = view.intrinsics.astype(np.float64)
    intrinsics[:2] *= np.array([[size[1] / width], [size[0] / height]])
    return Silhouette(area_mask(view.mask, *size), intrinsics, view.extrinsics.astype(np.float64))


def implausible(mask: np.ndarray) -> str | None:
    """What is wrong with a mask [h, w] by itself: too small, or full or inverted; None if nothing is."""
    border = np.concatenate((mask[0], mask[-1], mask[:, 0], mask[:, -1])).mean()
    if border > _MOST_BORDER:
        return (
            f"expected a mask of the subject, not of the background; found {border:.0%} of the border in it"
        )
    if mask.mean() < _LEAST_SHARE:
        return (
            f"expected a subject of {_LEAST_SHARE:.1%} of the photograph or more; found {mask.sum()} pixels"
        )
    return None


def height(silhouettes: Sequence[Silhouette]) -> float:
    """Median height of the subject in world units, as the silhouettes show it."""
    focus, _ = subject_sphere(silhouettes)
    return float(np.median([s.extent(focus)[0] for s in silhouettes]))


def twins(silhouettes: Mapping[int, Silhouette]) -> tuple[int, int] | None:
    """The first two positions whose cameras are the same; None if all differ."""
    listed = list(silhouettes.items())
    for i, (first, one) in enumerate(listed):
        for second, other in listed[i + 1 :]:
            if np.allclose(one.extrinsics, other.extrinsics, atol=1e-6):
                return first, second
    return None
