"""How photographs, masks and depth maps change their size.

Pixel centres lie at +0.5, so the middle of an old image is the middle of the new one. ``release`` functions
reproduce what the authors' code reads: OpenCV's nearest neighbour takes pixel floor(i * scale), which moves
masks by half an old pixel less half a new one.
"""

from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image

if TYPE_CHECKING:
    from scipy import sparse

#: Depths of one surface differ by less than this share between neighbouring pixels.
_SAME_SURFACE = 0.02


def area_image(image: np.ndarray, height: int, width: int) -> np.ndarray:
    """[height, width, ...] uint8: the mean over the area of each new pixel; bicubic when it grows."""
    h, w = image.shape[:2]
    if (h, w) == (height, width):
        return image
    if height > h or width > w:
        return release_image(image, height, width)
    if h % height == w % width == 0:  # a quarter of the time of the general case
        return np.asarray(Image.fromarray(image).reduce((w // width, h // height)))
    means = _area_means(image.reshape(h, w, -1), height, width).reshape(height, width, *image.shape[2:])
    return np.floor(means + 0.5).astype(np.uint8)


def area_mask(mask: np.ndarray, height: int, width: int) -> np.ndarray:
    """[height, width] bool: where at least half of the new pixel's area is in the mask."""
    if mask.shape == (height, width):
        return mask
    return _area_means(mask[..., None], height, width)[..., 0] > 0.5 - 1e-6


def centered_depth(inverse: np.ndarray, height: int, width: int) -> np.ndarray:
    """[height, width] uint16: inverse depth at the centre of each new pixel.

    Interpolated linearly among the four old pixels around it, which is exact for planes; of those, only the
    known ones on the nearest surface count, so that no surfaces are mixed.
    """
    if inverse.shape == (height, width):
        return inverse
    rows, down = _neighbors(inverse.shape[0], height)
    columns, across = _neighbors(inverse.shape[1], width)
    known = inverse.astype(np.float32)
    corners = [known[rows[i][:, None], columns[j]] for i in (0, 1) for j in (0, 1)]
    weights = [down[i][:, None] * across[j] for i in (0, 1) for j in (0, 1)]
    front = np.maximum.reduce([np.where(w > 0, c, 0) for c, w in zip(corners, weights, strict=True)])
    least = np.maximum((1 - _SAME_SURFACE) * front, 0.5)  # 0 is unknown
    total, mean = np.zeros_like(front), np.zeros_like(front)
    for corner, weight in zip(corners, weights, strict=True):
        counted = weight * (corner >= least)
        total += counted
        mean += counted * corner
    return np.where(total > 0, np.round(mean / np.where(total > 0, total, 1)), 0).astype(np.uint16)


def release_image(image: np.ndarray, height: int, width: int) -> np.ndarray:
    """[height, width, ...] uint8 by Pillow's bicubic filter."""
    return np.asarray(Image.fromarray(image).resize((width, height), Image.Resampling.BICUBIC))


def release_mask(mask: np.ndarray, height: int, width: int) -> np.ndarray:
    """[height, width] by OpenCV's nearest neighbour."""
    h, w = mask.shape
    rows, columns = (np.arange(n) * old // n for n, old in ((height, h), (width, w)))
    return np.ascontiguousarray(mask[rows[:, None], columns])


def _area_means(layers: np.ndarray, height: int, width: int) -> np.ndarray:
    """Means [height, width, c] float32 over the areas of new pixels, with exact weights."""
    h, w, channels = layers.shape
    lines = _area_weights(h, height) @ layers.reshape(h, w * channels).astype(np.float32)
    lines = np.moveaxis(lines.reshape(height, w, channels), 1, 0).reshape(w, height * channels)
    return np.moveaxis((_area_weights(w, width) @ lines).reshape(width, height, channels), 0, 1)


@lru_cache(maxsize=16)
def _area_weights(old: int, new: int) -> "sparse.csr_array":
    """[new, old]: which share of each new pixel each old one covers; rows sum to 1."""
    from scipy import sparse  # here: a wrong path is refused before it is needed

    edges = np.union1d(np.arange(old + 1) * new, np.arange(new + 1) * old)  # in units of 1 / (old * new)
    middles = (edges[:-1] + edges[1:]) / 2
    places = ((middles / old).astype(int), (middles / new).astype(int))
    shares = (np.diff(edges) / old).astype(np.float32)
    return sparse.coo_array((shares, places), shape=(new, old)).tocsr()


def _neighbors(old: int, new: int) -> tuple[np.ndarray, np.ndarray]:
    """Indices [2, new] of the old pixels around the centres of the new ones, and linear weights [2, new]."""
    place = (np.arange(new) + 0.5) * old / new - 0.5
    first = np.floor(place)
    second = (place - first).astype(np.float32)
    indices = np.stack((first, first + 1)).clip(0, old - 1).astype(int)
    return indices, np.stack((1 - second, second))
