"""One photograph with its mask, depth and camera."""

from dataclasses import dataclass, replace

import numpy as np

from ghgs_lit.data.resampling import area_image, area_mask, centered_depth, release_image, release_mask

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
        matte: [h, w] uint8, 255 times the share of each pixel that shows the subject, by which the image is
            premultiplied; or None.
    """

    image: np.ndarray
    mask: np.ndarray
    inverse_depth: np.ndarray | None
    intrinsics: np.ndarray
    extrinsics: np.ndarray
    matte: np.ndarray | None = None

    @property
    def depth(self) -> np.ndarray | None:
        """Metres [h, w] float32, 0 where unknown."""
        if self.inverse_depth is None:
            return None
        known = self.inverse_depth > 0
        return np.where(known, _DEPTH_SCALE / np.where(known, self.inverse_depth, 1), 0).astype(np.float32)

    @property
    def nbytes(self) -> int:
        maps = (self.image, self.mask, self.inverse_depth, self.matte)
        return sum(map_.nbytes for map_ in maps if map_ is not None) + 1024

    @property
    def alpha(self) -> np.ndarray | None:
        """The matte [h, w] float32 in [0, 1]."""
        return None if self.matte is None else self.matte.astype(np.float32) / 255


def encode_depth(depth: np.ndarray) -> np.ndarray:
    """Metres to uint16 inverse depth; 0 stays 0. At 2 m a step is 0.12 mm; nearer than 0.5 m saturates."""
    known = depth > 0
    inverse = np.round(_DEPTH_SCALE / np.where(known, depth, 1))
    return np.where(known, np.clip(inverse, 1, 65535), 0).astype(np.uint16)


def half_centers(intrinsics: np.ndarray) -> np.ndarray:
    """Intrinsics [3, 3] of pixel centres at integers for centres at +0.5."""
    return intrinsics + np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])


def opencv_view(image: np.ndarray, mask: np.ndarray, intrinsics: np.ndarray, extrinsics: np.ndarray) -> View:
    """A view from an OpenCV calibration: background to black, pixel centres from integers to +0.5.

    Args:
        image: [h, w, 3] uint8.
        mask: [h, w] bool.
        intrinsics: [3, 3] in pixels, pixel centres at integers.
        extrinsics: [4, 4], world to camera, metres.
    """
    image = np.where(mask[..., None], image, 0)
    return View(image, mask, None, half_centers(intrinsics).astype(np.float32), extrinsics.astype(np.float32))


def resize_view(view: View, height: int, width: int, resampling: str = "area") -> View:
    """Resize a photograph with its mask and depth map, and scale its intrinsics.

    ``resampling``: ``area`` keeps everything at its place; ``release``, as the authors' code, resizes
    photographs by Pillow's bicubic filter and masks by OpenCV's nearest neighbour. Mattes are resized as
    photographs, and the mask is where the subject fills half of a pixel or more. Depth is that at the centres
    of the subject's new pixels in both.
    """
    h, w = view.mask.shape
    if (h, w) == (height, width):
        return view
    intrinsics = view.intrinsics.astype(np.float64)
    intrinsics[:2] *= np.array([[width / w], [height / h]])
    resize = {"area": (area_image, area_mask), "release": (release_image, release_mask)}
    image, mask = resize[resampling]
    inverse, matte = view.inverse_depth, view.matte
    if matte is None:
        shown = subject = mask(view.mask, height, width)
    else:
        matte = image(matte, height, width)
        shown, subject = matte > 0, matte >= 128
    return replace(
        view,
        image=image(view.image, height, width),
        mask=subject,
        inverse_depth=None if inverse is None else centered_depth(inverse, height, width) * shown,
        intrinsics=intrinsics.astype(np.float32),
        matte=matte,
    )
