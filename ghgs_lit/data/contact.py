"""One picture of a data set: photographs with the outline of the mask and the vertices of the body."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw
from scipy import ndimage

from ghgs_lit.data.overlap import project
from ghgs_lit.data.view import View, resize_view

Tile = np.ndarray
_HEIGHT, _LINE = 176, 14
_GREEN, _RED, _GREY = (0, 255, 90), (255, 60, 40), (70, 70, 70)
_DOTS = 400


def draw_tile(view: View | None, body: np.ndarray | None) -> Tile:
    """Draw the outline of the mask in green and some vertices of the body in red.

    Args:
        view: the photograph; None draws a cross.
        body: vertices [n, 3] in the world, or None.

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
    """Save tiles as one picture, a row for each subject. ``rows``: (label, tile) pairs by name of the
    subject; labels are camera and IoU."""
    width = max(sum(tile.shape[1] + 2 for _, tile in tiles) for tiles in rows.values())
    step = _HEIGHT + 2 * _LINE
    sheet = Image.new("RGB", (width, step * len(rows)))
    draw = ImageDraw.Draw(sheet)
    for n, (name, tiles) in enumerate(rows.items()):
        draw.text((2, n * step), name, "white")
        left = 0
        for label, tile in tiles:
            sheet.paste(Image.fromarray(tile), (left, n * step + _LINE))
            draw.text((left + 2, n * step + _LINE + _HEIGHT), label, "white")
            left += tile.shape[1] + 2
    sheet.save(path)
