"""Checks of a person's masks: each one alone, against the body, and against the other masks."""

import itertools
from collections.abc import Mapping, Sequence

import numpy as np

from ghgs_lit.data.view import View, area_mask
from ghgs_lit.geometry.silhouettes import HullSearch, Silhouette, subject_sphere

# Longer side of a coarse mask in cells.
_CELLS = 64
#: Comparison of masks; a quarter of them may be wrong.
SEARCH = HullSearch(rays=200, depths=64, reach=1.0, others=12, wrong=0.25)
# Minimum share of an image, and maximum share of its border, that a person covers.
_LEAST_SHARE = 1e-3
_MOST_BORDER = 0.5
# Minimum number of vertices that fill a silhouette.
_LEAST_VERTICES = 500
# Maximum height of a body in cells; with more, cells between vertices of SMPL's torso stay empty.
_BODY_CELLS = 96


def make_silhouette(view: View) -> Silhouette:
    """Make a silhouette from the mask and camera of a view, at most 64 cells high and wide."""
    height, width = view.mask.shape
    scale = min(_CELLS / max(height, width), 1)
    size = max(round(height * scale), 1), max(round(width * scale), 1)
    intrinsics = view.intrinsics.astype(np.float64)
    intrinsics[:2] *= np.array([[size[1] / width], [size[0] / height]])
    return Silhouette(area_mask(view.mask, *size), intrinsics, view.extrinsics.astype(np.float64))


def find_mask_problem(mask: np.ndarray) -> str | None:
    """Message if a mask, [h, w] bool and true on the subject, is too small, full or inverted; else None."""
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


def measure_height(silhouettes: Sequence[Silhouette]) -> float:
    """Median height in world units of the subject of several silhouettes."""
    focus, _ = subject_sphere(silhouettes)
    return float(np.median([s.extent(focus)[0] for s in silhouettes]))


def find_equal_poses(poses: Mapping[str, np.ndarray]) -> tuple[str, str] | None:
    """Names of the first two equal poses among [4, 4] poses by name; None if all differ."""
    pairs = itertools.combinations(poses, 2)
    return next((p for p in pairs if np.allclose(poses[p[0]], poses[p[1]], rtol=1e-6, atol=1e-6)), None)


def measure_overlap(vertices: np.ndarray, view: View) -> float | None:
    """IoU of the silhouette of a body and a mask.

    The silhouette is made on a grid so coarse that vertices can be joined without faces. Parts outside
    the image are ignored.

    Args:
        vertices: [n, 3] in the world, metres.
        view: the view whose mask and camera are compared.

    Returns:
        IoU in [0, 1]; None with fewer than 500 vertices.
    """
    from scipy import ndimage  # not needed where only masks are checked

    if len(vertices) < _LEAST_VERTICES:
        return None
    height, width = view.mask.shape
    pose = view.extrinsics.astype(np.float64)
    points = vertices.astype(np.float64) @ pose[:3, :3].T + pose[:3, 3]
    points = points[points[:, 2] > 1e-6] @ view.intrinsics.astype(np.float64).T
    pixels = points[:, :2] / points[:, 2:]
    pixels = pixels[((pixels >= 0) & (pixels < (width, height))).all(-1)]
    if not len(pixels):
        return 0.0
    cells = min(_BODY_CELLS, int(1.2 * np.sqrt(len(vertices))))
    cell = max(np.ptp(pixels[:, 1]) / cells, 1.0)
    rows = max(round(height / cell), 1)
    columns = max(round(width / cell), 1)
    margin = 3
    hit = np.zeros((rows + 2 * margin, columns + 2 * margin), bool)
    row = (pixels[:, 1] * rows / height).astype(int)
    column = (pixels[:, 0] * columns / width).astype(int)
    hit[row + margin, column + margin] = True
    # Gaps of up to four cells are closed, holes filled.
    closed = ndimage.binary_closing(hit, np.ones((3, 3)), iterations=2)
    body = ndimage.binary_fill_holes(closed)[margin:-margin, margin:-margin]
    subject = area_mask(view.mask, rows, columns)
    return float((body & subject).sum() / max((body | subject).sum(), 1))
