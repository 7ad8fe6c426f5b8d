"""One photograph with its mask, depth and camera, and how it is resized."""

from dataclasses import dataclass, replace

import numpy as np
from PIL import Image

_DEPTH_SCALE = 1 << 15


@dataclass(frozen=True)
class View:
    """One photograph.

    Attributes:
        image: [h, w, 3] uint8, RGB.
        mask: [h, w] bool, true on the subject.
        inverse_depth: [h, w] uint16, 2^15 / metres, 0 where unknown; or None.
        intrinsics: [3, 3] float32 in pixels, pixel centres at +0.5.
        extrinsics: [4, 4] float32, world to camera, metres, OpenCV axes.
    """

    image: np.ndarray
    mask: np.ndarray
    inverse_depth: np.ndarray | None
    intrinsics: np.ndarray
    extrinsics: np.ndarray

    @property
    def depth(self) -> np.ndarray | None:
        """Metres [h, w] float32, 0 where unknown."""
        if self.inverse_depth is None:
            return None
        known = self.inverse_depth > 0
        return np.where(known, _DEPTH_SCALE / np.where(known, self.inverse_depth, 1), 0).astype(np.float32)

    @property
    def nbytes(self) -> int:
        return self.image.nbytes + self.mask.nbytes + getattr(self.inverse_depth, "nbytes", 0) + 1024


def encode_depth(depth: np.ndarray) -> np.ndarray:
    """Metres to uint16 inverse depth; 0 stays 0. At 2 m a step is 0.12 mm; nearer than 0.5 m saturates."""
    known = depth > 0
    inverse = np.round(_DEPTH_SCALE / np.where(known, depth, 1))
    return np.where(known, np.clip(inverse, 1, 65535), 0).astype(np.uint16)


def opencv_view(image: np.ndarray, mask: np.ndarray, intrinsics: np.ndarray, extrinsics: np.ndarray) -> View:
    """A view from an OpenCV calibration: background to black, pixel centres from integers to +0.5.

    Args:
        image: [h, w, 3] uint8.
        mask: [h, w] bool.
        intrinsics: [3, 3] in pixels, pixel centres at integers.
        extrinsics: [4, 4], world to camera, metres.
    """
    intrinsics = np.array(intrinsics)
    intrinsics[:2, 2] += 0.5
    image = np.where(mask[..., None], image, 0)
    return View(image, mask, None, intrinsics.astype(np.float32), extrinsics.astype(np.float32))


def resize_view(view: View, height: int, width: int) -> View:
    """Resize the image by area, mask and depth to the nearest value, and scale the intrinsics."""
    h, w = view.mask.shape
    if (h, w) == (height, width):
        return view
    scale = np.array([[width / w], [height / h]], np.float64)
    intrinsics = view.intrinsics.astype(np.float64)
    intrinsics[:2] *= scale
    depth = view.inverse_depth
    return replace(
        view,
        image=resize_image(view.image, height, width),
        mask=_resize_nearest(view.mask, height, width),
        inverse_depth=None if depth is None else _resize_nearest(depth, height, width),
        intrinsics=intrinsics.astype(np.float32),
    )


def resize_image(image: np.ndarray, height: int, width: int) -> np.ndarray:
    """[height, width, 3] uint8: the mean over the area of each new pixel; bicubic when it grows."""
    h, w = image.shape[:2]
    if (h, w) == (height, width):
        return image
    if h % height == w % width == 0:  # a quarter of the time of the general case
        return np.asarray(Image.fromarray(image).reduce((w // width, h // height)))
    method = Image.Resampling.BOX if width <= w and height <= h else Image.Resampling.BICUBIC
    return np.asarray(Image.fromarray(image).resize((width, height), method))


def _resize_nearest(array: np.ndarray, height: int, width: int) -> np.ndarray:
    """The value at the centre of each new pixel, so that mask and depth agree and mix no surfaces."""
    rows = ((np.arange(height) + 0.5) * array.shape[0] / height).astype(int)
    columns = ((np.arange(width) + 0.5) * array.shape[1] / width).astype(int)
    return np.ascontiguousarray(array[rows[:, None], columns])
