"""Cameras checked by eye: photographs with masks, hulls and epipolar lines."""

from collections.abc import Sequence

import numpy as np
from PIL import Image, ImageDraw
from scipy import ndimage

from ghgs_lit.geometry.silhouettes import Silhouette, hull_in_view, subject_sphere
from ghgs_lit.visualization.pictures import row, stack

# Cells of the hull along the longer side of a photograph, and steps of an epipolar line.
_CELLS = 160
_STEPS = 200
_MASK = (0, 255, 90)
_HULL = (255, 60, 40)
_COLORS = ((255, 220, 0), (0, 200, 255), (255, 120, 255), (255, 160, 60), (160, 255, 120))


def camera_sheet(
    names: Sequence[str], images: Sequence[np.ndarray], views: Sequence[Silhouette]
) -> np.ndarray:
    """Draw masks, hulls and epipolar lines, by which cameras can be checked by eye.

    The first row has masks (green) and the hull of the other masks (red). Each further row begins
    with points of one mask; the other pictures show the line on which each point must be, near the
    subject's depth: it passes the same part of the body in every photograph.

    Args:
        names: of the photographs.
        images: the photographs [h, w, 3] uint8, without distortion.
        views: their masks, of the photographs' sizes, with their cameras.

    Returns:
        The picture [H, W, 3] uint8.
    """
    focus, radius = subject_sphere(views)
    small = [_smaller(view) for view in views]
    tiles = []
    for i, (image, view) in enumerate(zip(images, views, strict=True)):
        hull = Image.fromarray(hull_in_view(small, i)).resize(view.mask.shape[::-1], Image.Resampling.NEAREST)
        picture = image.copy()
        for shape, color in ((np.asarray(hull), _HULL), (view.mask, _MASK)):
            picture[shape ^ ndimage.binary_erosion(shape)] = color
        tiles.append(picture)
    rows = [row(tiles, [f"{name}: its mask green, the hull of the other masks red" for name in names])]
    for i, view in enumerate(views):
        order = [i, *(j for j in range(len(views)) if j != i)]
        points = _extremes(view.mask)
        depths = view.depths_around(focus, radius, _STEPS)
        tiles = [_dots(images[i], points)]
        tiles += [_lines(images[j], view, views[j], points, depths) for j in order[1:]]
        rows.append(row(tiles, [f"points of {names[i]}", *(f"on {names[j]}" for j in order[1:])]))
    return stack(rows)


def _smaller(view: Silhouette) -> Silhouette:
    """The view with every n-th pixel of its mask, at most ``_CELLS`` a side."""
    step = max(-(-max(view.mask.shape) // _CELLS), 1)
    intrinsics = view.intrinsics.copy()
    intrinsics[:2] /= step
    return Silhouette(view.mask[step // 2 :: step, step // 2 :: step], intrinsics, view.extrinsics)


def _extremes(mask: np.ndarray) -> np.ndarray:
    """Pixels [5, 2] (column, row): the mask's top, bottom, left and right ones,
    and one in its middle."""
    pixels = np.argwhere(mask)[:, ::-1]
    middle = np.abs(pixels - np.median(pixels, 0)).sum(1).argmin()
    ends = [pixels[:, 1].argmin(), pixels[:, 1].argmax(), pixels[:, 0].argmin(), pixels[:, 0].argmax()]
    return pixels[[*ends, middle]] + 0.5


def _dots(image: np.ndarray, points: np.ndarray) -> np.ndarray:
    picture = Image.fromarray(image)
    draw = ImageDraw.Draw(picture)
    for (x, y), color in zip(points.tolist(), _COLORS, strict=True):
        draw.ellipse((x - 3, y - 3, x + 3, y + 3), fill=color)
    return np.asarray(picture)


def _lines(
    image: np.ndarray, view: Silhouette, other: Silhouette, points: np.ndarray, depths: np.ndarray
) -> np.ndarray:
    """Draw the rays of points of one view on the photograph of another.

    Args:
        image: the other photograph [h, w, 3] uint8.
        view: the mask and camera of the points.
        other: the camera of the photograph.
        points: [5, 2] (column, row) in pixels of ``view``.
        depths: [n] z-depths in ``view``, in the unit of the cameras, between which rays are drawn.

    Returns:
        The picture [h, w, 3] uint8.
    """
    picture = Image.fromarray(image)
    draw = ImageDraw.Draw(picture)
    for ray, color in zip(view.rays(points), _COLORS, strict=True):
        local = (view.center + ray * depths[:, None]) @ other.extrinsics[:3, :3].T + other.extrinsics[:3, 3]
        local = local[local[:, 2] > 0]
        pixels = local @ other.intrinsics.T
        line = (pixels[:, :2] / pixels[:, 2:]).clip(-1e4, 1e4)
        if len(line) > 1:
            draw.line([tuple(p) for p in line.tolist()], fill=color, width=1)
    return np.asarray(picture)
