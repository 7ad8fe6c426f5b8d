"""An image with its mask, depth map and camera, and their resizing.

Resizing preserves the image's centre. Functions named ``release_*`` reproduce the authors' code: OpenCV's
nearest neighbour reads pixel floor(i * scale), which shifts masks by half an old pixel minus half a new
one.
"""

import itertools
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image

if TYPE_CHECKING:
    from scipy import sparse

#: Maximum relative difference between depths of one surface at neighbouring pixels.
SAME_SURFACE = 0.02


def area_image(image: np.ndarray, height: int, width: int) -> np.ndarray:
    """Resize an image [h, w, ...] uint8 to the mean over the area of each new pixel; bicubic if it is
    enlarged."""
    h, w = image.shape[:2]
    if (h, w) == (height, width):
        return image
    if height > h or width > w:
        return release_image(image, height, width)
    if h % height == w % width == 0:  # four times as fast as the general case
        return np.asarray(Image.fromarray(image).reduce((w // width, h // height)))
    means = _area_means(image.reshape(h, w, -1), height, width).reshape(height, width, *image.shape[2:])
    return np.floor(means + 0.5).astype(np.uint8)


def area_mask(mask: np.ndarray, height: int, width: int) -> np.ndarray:
    """Resize a mask [h, w] bool: true where the mask covers at least half of a new pixel's area."""
    if mask.shape == (height, width):
        return mask
    return _area_means(mask[..., None], height, width)[..., 0] > 0.5 - 1e-6


def resample_depth(inverse: np.ndarray, height: int, width: int) -> np.ndarray:
    """Resize a map of inverse depth by sampling it at the centres of new pixels.

    Values are interpolated bilinearly (exact for planes) between those of the four neighbouring pixels
    that are known and lie on the nearest surface.

    Args:
        inverse: [h, w] uint16, 2^15 / metres; 0 where unknown.
        height: height of the result in pixels.
        width: width of the result in pixels.

    Returns:
        [height, width] uint16.
    """
    if inverse.shape == (height, width):
        return inverse
    rows, down = neighbors(inverse.shape[0], height)
    columns, across = neighbors(inverse.shape[1], width)
    known = inverse.astype(np.float32)
    places = list(itertools.product((0, 1), (0, 1)))
    corners = [known[rows[i][:, None], columns[j]] for i, j in places]
    weights = [down[i][:, None] * across[j] for i, j in places]
    front = np.maximum.reduce([np.where(w > 0, c, 0) for c, w in zip(corners, weights, strict=True)])
    least = np.maximum((1 - SAME_SURFACE) * front, 0.5)  # 0 is unknown
    total = np.zeros_like(front)
    mean = np.zeros_like(front)
    for corner, weight in zip(corners, weights, strict=True):
        counted = weight * (corner >= least)
        total += counted
        mean += counted * corner
    return np.where(total > 0, np.round(mean / np.where(total > 0, total, 1)), 0).astype(np.uint16)


def release_image(image: np.ndarray, height: int, width: int) -> np.ndarray:
    """Resize an image [h, w, ...] uint8 with Pillow's bicubic filter, as the authors' code does."""
    return np.asarray(Image.fromarray(image).resize((width, height), Image.Resampling.BICUBIC))


def release_mask(mask: np.ndarray, height: int, width: int) -> np.ndarray:
    """Resize a mask [h, w] with OpenCV's nearest neighbour, as the authors' code does."""
    h, w = mask.shape
    rows = np.arange(height) * h // height
    columns = np.arange(width) * w // width
    return np.ascontiguousarray(mask[rows[:, None], columns])


def _area_means(layers: np.ndarray, height: int, width: int) -> np.ndarray:
    """Exactly weighted means over the areas of new pixels, [height, width, c] float32."""
    h, w, channels = layers.shape
    lines = area_weights(h, height) @ layers.reshape(h, w * channels).astype(np.float32)
    lines = np.moveaxis(lines.reshape(height, w, channels), 1, 0).reshape(w, height * channels)
    return np.moveaxis((area_weights(w, width) @ lines).reshape(width, height, channels), 0, 1)


@lru_cache(maxsize=16)
def area_weights(old: int, new: int) -> "sparse.csr_array":
    """Share of each new pixel that each old pixel covers, along one side.

    Args:
        old: number of pixels of the old side.
        new: number of pixels of the new side.

    Returns:
        [new, old]; rows sum to 1.
    """
    from scipy import sparse  # here, so that wrong paths are rejected before this slow import

    # in units of 1 / (old * new)
    edges = np.union1d(np.arange(old + 1) * new, np.arange(new + 1) * old)
    middles = (edges[:-1] + edges[1:]) / 2
    places = ((middles / old).astype(int), (middles / new).astype(int))
    shares = (np.diff(edges) / old).astype(np.float32)
    return sparse.coo_array((shares, places), shape=(new, old)).tocsr()


def neighbors(old: int, new: int) -> tuple[np.ndarray, np.ndarray]:
    """The two old pixels around the centre of each new pixel, along one side.

    Args:
        old: number of pixels of the old side.
        new: number of pixels of the new side.

    Returns:
        Indices [2, new] and linear weights [2, new].
    """
    place = (np.arange(new) + 0.5) * old / new - 0.5
    first = np.floor(place)
    second = (place - first).astype(np.float32)
    indices = np.stack((first, first + 1)).clip(0, old - 1).astype(int)
    return indices, np.stack((1 - second, second))


DEPTH_SCALE = 1 << 15


@dataclass(frozen=True)
class View:
    """An image with its maps and camera.

    Attributes:
        image: [h, w, 3] uint8, RGB.
        mask: [h, w] bool, true on the subject.
        inverse_depth: [h, w] uint16, 2^15 / metres, 0 where unknown; or None.
        intrinsics: [3, 3] float32 in pixels, pixel centres at +0.5.
        extrinsics: [4, 4] float32, world to camera, metres, OpenCV axes.
        matte: [h, w] uint8, 255 times the share of each pixel that shows the subject, by which the
            image is premultiplied; or None.
    """

    image: np.ndarray
    mask: np.ndarray
    inverse_depth: np.ndarray | None
    intrinsics: np.ndarray
    extrinsics: np.ndarray
    matte: np.ndarray | None = None

    @property
    def depth(self) -> np.ndarray | None:
        """Depth [h, w] float32 in metres, 0 where unknown."""
        if self.inverse_depth is None:
            return None
        known = self.inverse_depth > 0
        return np.where(known, DEPTH_SCALE / np.where(known, self.inverse_depth, 1), 0).astype(np.float32)

    @property
    def alpha(self) -> np.ndarray | None:
        """Matte [h, w] float32 in [0, 1]."""
        return None if self.matte is None else np.divide(self.matte, 255, dtype=np.float32)


def encode_depth(depth: np.ndarray) -> np.ndarray:
    """Encode depth as inverse depth, uint16 of 2^15 / metres.

    At 2 m the resolution is 0.12 mm; depths below 0.5 m saturate.

    Args:
        depth: depth in metres, any shape; 0 where unknown, which stays 0.
    """
    known = depth > 0
    inverse = np.round(DEPTH_SCALE / np.where(known, depth, 1))
    return np.where(known, np.clip(inverse, 1, 65535), 0).astype(np.uint16)


def half_centers(intrinsics: np.ndarray) -> np.ndarray:
    """Convert intrinsics [3, 3] from pixel centres at integers to centres at +0.5."""
    return intrinsics + np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])


def resize_view(view: View, size: tuple[int, int] | None, resampling: str = "area") -> View:
    """Resize an image with its maps, and scale its intrinsics.

    Mattes are resized like images, and the mask is then true where they are at least half. Depth is
    sampled at the centres of new pixels.

    Args:
        size: new (height, width) in pixels; None: unchanged.
        resampling: ``area`` shifts nothing; ``release``, as in the authors' code, resizes images with
            Pillow's bicubic filter and masks with OpenCV's nearest neighbour.
    """
    if size in (None, view.mask.shape):
        return view
    h, w = view.mask.shape
    height, width = size
    intrinsics = view.intrinsics.astype(np.float64)
    intrinsics[:2] *= np.array([[width / w], [height / h]])
    resize = {"area": (area_image, area_mask), "release": (release_image, release_mask)}
    image, mask = resize[resampling]
    inverse = view.inverse_depth
    matte = view.matte
    if matte is None:
        shown = subject = mask(view.mask, height, width)
    else:
        matte = image(matte, height, width)
        shown = matte > 0
        subject = matte >= 128
    return replace(
        view,
        image=image(view.image, height, width),
        mask=subject,
        inverse_depth=None if inverse is None else resample_depth(inverse, height, width) * shown,
        intrinsics=intrinsics.astype(np.float32),
        matte=matte,
    )
