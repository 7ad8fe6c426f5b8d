"""One photograph of a capture, and its crop for a model's input."""

import warnings
from dataclasses import dataclass, replace

import numpy as np

from ghgs_lit.data.view import area_image

#: Share of a crop's height or width that the subject fills, as in training images
SHARE = 0.8
_FINER = 2  #: Largest size at which mattes are refined, relative to the crop's


@dataclass(frozen=True)
class Photograph:
    """One photograph without lens distortion, upright."""

    name: str
    image: np.ndarray  #: [h, w, 3] uint8, RGB
    matte: np.ndarray  #: [h, w] uint8, 255 times the share of each pixel that shows the subject
    intrinsics: np.ndarray  #: [3, 3] float64 in pixels, pixel centres at +0.5
    extrinsics: np.ndarray  #: [4, 4] float64, world to camera, OpenCV axes, in the user's unit
    gains: np.ndarray | None = None  #: [3], relative to other cameras; None: not known

    @property
    def mask(self) -> np.ndarray:
        """[h, w] bool, true where the subject fills half of a pixel or more."""
        return self.matte > 127

    @property
    def extents(self) -> list[tuple[int, int]]:
        """(first, end) rows, then columns of the subject; ``end`` is exclusive."""
        lines = (np.nonzero(self.mask.any(axis))[0] for axis in (1, 0))
        return [(int(occupied[0]), int(occupied[-1]) + 1) for occupied in lines]


def crop_to_subject(photograph: Photograph, size: tuple[int, int], refine_masks: int = 0) -> Photograph:
    """Crop a photograph so that the subject is in the centre, and adapt its camera.

    The crop is black outside of the photograph and of the subject. A large photograph's sharp mask becomes
    a soft matte. If the photograph's border cuts the subject, the crop ends at that border, since black
    pixels next to it would look like the subject's boundary.

    Args:
        photograph: shows the subject in at least one pixel.
        size: (height, width) of the crop in pixels.
        refine_masks: as for :meth:`ghgs_capture.capture.Capture.batch`.

    Returns:
        The crop as a photograph of ``size``, with its intrinsics.
    """
    extents = photograph.extents
    scale = max((end - first) / (SHARE * side) for (first, end), side in zip(extents, size, strict=True))
    spans = [
        _span(first, end, max(round(scale * side), 1), whole)
        for (first, end), side, whole in zip(extents, size, photograph.mask.shape, strict=True)
    ]
    (top, bottom), (left, right) = spans
    factors = np.array([size[1] / (right - left), size[0] / (bottom - top)])
    intrinsics = photograph.intrinsics.copy()
    intrinsics[:2, 2] -= [left, top]
    intrinsics[:2] *= factors[:, None]
    image = _cut(photograph.image, spans)
    matte = _cut(photograph.matte, spans)
    # Before resizing, so that the background does not bleed into the rim.
    if refine_masks:
        image, matte = _refine(photograph.name, image, matte, size, refine_masks)
    else:
        image = _on_black(image, matte)
    return replace(
        photograph, image=area_image(image, *size), matte=area_image(matte, *size), intrinsics=intrinsics
    )


def shrink(photograph: Photograph, factor: int) -> Photograph:
    """Downsample a photograph by averaging blocks of pixels.

    Args:
        photograph: with sides of at least ``factor`` pixels.
        factor: side of a block in pixels; incomplete blocks at the right and the bottom are cropped.

    Returns:
        The downsampled photograph with its camera.
    """
    if factor == 1:
        return photograph
    rows, columns = (side // factor for side in photograph.matte.shape)
    whole = slice(rows * factor), slice(columns * factor)
    image = area_image(photograph.image[whole], rows, columns)
    matte = area_image(photograph.matte[whole], rows, columns)
    intrinsics = photograph.intrinsics / np.array([[factor], [factor], [1.0]])
    return replace(photograph, image=image, matte=matte, intrinsics=intrinsics)


def _refine(
    name: str, image: np.ndarray, matte: np.ndarray, size: tuple[int, int], pixels: int
) -> tuple[np.ndarray, np.ndarray]:
    """Refine the matte of a cut; keeps it, with a warning, if the area would change by more than a factor
    of two."""
    # imported here so that photographs are read while PyTorch is imported
    from ghgs_lit.data.matting import refine_matte

    sides = [min(_FINER * side, whole) for side, whole in zip(size, matte.shape, strict=True)]
    image = area_image(image, *sides)
    matte = area_image(matte, *sides)
    subject, refined = refine_matte(image, matte, pixels * sides[0] / size[0])
    share = (refined > 127).sum() / max((matte > 127).sum(), 1)
    if 0.5 <= share <= 2:
        return subject, refined
    warnings.warn(
        f"refine_masks: expected colours of {name} that tell the subject from what is behind it; found"
        f" {share:.2g} times the mask's area, so that the mask stays as it is",
        stacklevel=4,
    )
    return _on_black(image, matte), matte


def _on_black(image: np.ndarray, matte: np.ndarray) -> np.ndarray:
    return np.round(image * (matte[..., None] / np.float32(255))).astype(np.uint8)


def _span(first: int, end: int, length: int, whole: int) -> tuple[int, int]:
    """Place a crop along one axis as (first, end) pixels, which may lie outside of the photograph; it ends
    where the photograph's border cuts the subject."""
    if first == 0 and end == whole:
        return 0, whole
    start = (first + end - length) // 2
    if first == 0:
        start = 0
    elif end == whole:
        start = whole - length
    return start, start + length


def _cut(image: np.ndarray, spans: list[tuple[int, int]]) -> np.ndarray:
    """Crop to ``spans`` (rows, then columns), with 0 outside of the photograph."""
    inside = tuple(slice(max(a, 0), min(b, side)) for (a, b), side in zip(spans, image.shape, strict=False))
    pads = [(max(-a, 0), max(b - side, 0)) for (a, b), side in zip(spans, image.shape, strict=False)]
    return np.pad(image[inside], pads + [(0, 0)] * (image.ndim - 2))
