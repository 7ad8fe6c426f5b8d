"""Checks of a person's masks without a body: each by itself, and against the others."""

import itertools
from collections.abc import Mapping, Sequence
from typing import TypeVar

import numpy as np

from ghgs_lit.data.view import View, area_mask
from ghgs_lit.geometry.silhouettes import HullSearch, Silhouette, subject_sphere

_T = TypeVar("_T")
# Largest side of a coarse mask in cells.
_CELLS = 64
#: Comparison of masks, of which a quarter may be wrong.
SEARCH = HullSearch(rays=200, depths=64, reach=1.0, others=12, wrong=0.25)
# Least share of a photograph and greatest share of its border that a person covers.
_LEAST_SHARE = 1e-3
_MOST_BORDER = 0.5


def silhouette(view: View) -> Silhouette:
    """Coarse silhouette of a photograph, at most 64 cells high and wide.

    Args:
        view: the photograph; its mask and camera are read.
    """
    height, width = view.mask.shape
    scale = min(_CELLS / max(height, width), 1)
    size = max(round(height * scale), 1), max(round(width * scale), 1)
    intrinsics = view.intrinsics.astype(np.float64)
    intrinsics[:2] *= np.array([[size[1] / width], [size[0] / height]])
    return Silhouette(area_mask(view.mask, *size), intrinsics, view.extrinsics.astype(np.float64))


def implausible(mask: np.ndarray) -> str | None:
    """Message if a mask is too small, full or inverted; else None.

    Args:
        mask: [h, w] bool, true on the subject.
    """
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
    """Median height of the subject in world units.

    Args:
        silhouettes: of one subject.
    """
    focus, _ = subject_sphere(silhouettes)
    return float(np.median([s.extent(focus)[0] for s in silhouettes]))


def twins(poses: Mapping[_T, np.ndarray]) -> tuple[_T, _T] | None:
    """Names of the first two equal poses; None if all differ.

    Args:
        poses: [4, 4] by name.
    """
    pairs = itertools.combinations(poses, 2)
    return next((p for p in pairs if np.allclose(poses[p[0]], poses[p[1]], rtol=1e-6, atol=1e-6)), None)
