"""Overlap of projected bodies and masks, which reveals wrong units, axes and centres,
and pictures of it."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw
from scipy import ndimage

from ghgs_lit.data.view import View, area_image, resize_view

# Fewer vertices do not fill a silhouette.
MIN_VERTICES = 500
# Height of a body in cells; with more, cells between vertices of SMPL's torso would stay empty.
_CELLS = 96


def project(vertices: np.ndarray, view: View) -> np.ndarray:
    """Pixels [m, 2] (u, v), float64, of the vertices in front of the camera.

    Args:
        vertices: [n, 3] in the world, metres.
        view: its camera is read.
    """
    pose = view.extrinsics.astype(np.float64)
    matrix = view.intrinsics.astype(np.float64)
    points = vertices.astype(np.float64) @ pose[:3, :3].T + pose[:3, 3]
    points = points[points[:, 2] > 1e-6] @ matrix.T
    return points[:, :2] / points[:, 2:]


def overlap(vertices: np.ndarray, view: View) -> float | None:
    """IoU of the silhouette of a body and a mask.

    The silhouette is taken on a grid so coarse that vertices can be joined without faces. Parts
    outside the photograph do not count.

    Args:
        vertices: [n, 3] in the world, metres.
        view: the photograph; its mask and camera are read.

    Returns:
        IoU in [0, 1]; None with fewer than :data:`MIN_VERTICES` vertices.
    """
    if len(vertices) < MIN_VERTICES:
        return None
    height, width = view.mask.shape
    pixels = project(vertices, view)
    shown = ((pixels >= 0) & (pixels < (width, height))).all(-1)
    if not shown.any() or not view.mask.any():
        return 0.0
    pixels = pixels[shown]
    cells = min(_CELLS, int(1.2 * np.sqrt(len(vertices))))
    cell = max(np.ptp(pixels[:, 1]) / cells, 1.0)
    rows = max(round(height / cell), 1)
    columns = max(round(width / cell), 1)
    share = area_image(np.repeat(view.mask[..., None] * np.uint8(255), 3, -1), rows, columns)[..., 0]
    hit = np.zeros((rows, columns), bool)
    row = (pixels[:, 1] * rows / height).astype(int)
    column = (pixels[:, 0] * columns / width).astype(int)
    hit[row, column] = True
    body = _joined(hit)
    subject = share >= 128
    return float((body & subject).sum() / max((body | subject).sum(), 1))


def _joined(hit: np.ndarray) -> np.ndarray:
    """Silhouette of scattered hits: gaps of up to four cells closed, holes filled."""
    margin = 3
    closed = ndimage.binary_closing(np.pad(hit, margin), np.ones((3, 3)), iterations=2)
    return ndimage.binary_fill_holes(closed)[margin:-margin, margin:-margin]


Tile = np.ndarray
_HEIGHT = 176
_LINE = 14
_GREEN = (0, 255, 90)
_RED = (255, 60, 40)
_GREY = (70, 70, 70)
_DOTS = 400


def draw_tile(view: View | None, body: np.ndarray | None) -> Tile:
    """A small picture of a photograph, the outline of its mask in green, and some vertices in red.

    Args:
        view: the photograph; None: a cross.
        body: vertices [n, 3] in the world, metres; None: none.

    Returns:
        [176, w, 3] uint8.
    """
    if view is None:
        image = Image.new("RGB", (_HEIGHT, _HEIGHT), _GREY)
        draw = ImageDraw.Draw(image)
        draw.line((0, 0, _HEIGHT, _HEIGHT), _RED, 2)
        draw.line((0, _HEIGHT, _HEIGHT, 0), _RED, 2)
        return np.asarray(image)
    h, w = view.mask.shape
    small = resize_view(view, _HEIGHT, max(round(w * _HEIGHT / h), 1))
    tile = small.image.copy()
    tile[small.mask ^ ndimage.binary_erosion(small.mask)] = _GREEN
    if body is not None:
        pixels = np.floor(project(body[:: max(len(body) // _DOTS, 1)], small)).astype(int)
        pixels = pixels[((pixels >= 0) & (pixels < (tile.shape[1], _HEIGHT))).all(-1)]
        tile[pixels[:, 1], pixels[:, 0]] = _RED
    return tile


def save_sheet(rows: Mapping[str, Sequence[tuple[str, Tile]]], path: Path) -> None:
    """Save tiles as one picture, a row for each subject.

    Args:
        rows: (label, tile) pairs by subject.
        path: of the picture.
    """
    widths = []
    for tiles in rows.values():
        widths.append(sum(tile.shape[1] + 2 for _, tile in tiles))
    step = _HEIGHT + 2 * _LINE
    sheet = Image.new("RGB", (max(widths), step * len(rows)))
    draw = ImageDraw.Draw(sheet)
    for n, (name, tiles) in enumerate(rows.items()):
        draw.text((2, n * step), name, "white")
        left = 0
        for label, tile in tiles:
            sheet.paste(Image.fromarray(tile), (left, n * step + _LINE))
            draw.text((left + 2, n * step + _LINE + _HEIGHT), label, "white")
            left += tile.shape[1] + 2
    sheet.save(path)
