"""Cameras checked by eye: photographs with masks and hulls."""

from collections.abc import Sequence

import numpy as np
from PIL import Image
from scipy import ndimage

from ghgs_lit.geometry.silhouettes import Silhouette, hull_in_view
from ghgs_lit.visualization.pictures import row

_CELLS = 160  # of the hull along the longer side of a photograph
_MASK, _HULL = (0, 255, 90), (255, 60, 40)


def camera_sheet(
    names: Sequence[str], images: Sequence[np.ndarray], views: Sequence[Silhouette]
) -> np.ndarray:
    """Picture [H, W, 3] uint8: photographs with outlines of masks (green) and of the others' hull (red).
    ``images``: [h, w, 3] uint8. ``views``: masks of the photographs' sizes with their cameras."""
    small, tiles = [_smaller(view) for view in views], []
    for i, (image, view) in enumerate(zip(images, views, strict=True)):
        hull = Image.fromarray(hull_in_view(small, i)).resize(view.mask.shape[::-1], Image.Resampling.NEAREST)
        picture = image.copy()
        for shape, color in ((np.asarray(hull), _HULL), (view.mask, _MASK)):
            picture[shape ^ ndimage.binary_erosion(shape)] = color
        tiles.append(picture)
    return row(tiles, [f"{name}: mask green, hull of the others red" for name in names])


def _smaller(view: Silhouette) -> Silhouette:
    step = max(-(-max(view.mask.shape) // _CELLS), 1)
    intrinsics = view.intrinsics.copy()
    intrinsics[:2] /= step
    return Silhouette(view.mask[step // 2 :: step, step // 2 :: step], intrinsics, view.extrinsics)
