"""Mattes of the subject in photographs, from a file, alpha, a photograph of the background, or rembg.

A matte [h, w] uint8 is 255 times the share of each pixel that the subject covers; a mask contains only 0
and 255.
"""

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
from PIL import Image

from ghgs_capture.calibration import same_ratio
from ghgs_capture.photographs import MASK_ENDING, Pixels, find_image, find_similar_mask, read_pixels
from ghgs_lit.data.decoding import read_image
from ghgs_lit.errors import import_optional, require, require_choice

SEGMENTERS = ("rembg",)  #: Choices of ``segment``
_LABELS = 32  # Labels of body parts are below this; alpha and probabilities reach 255
# Least difference of a pixel from the background: in standard deviations of the noise, and in levels
_DEVIATIONS = 6.0
_LEAST_DIFFERENCE = 12.0
_SPECK = 0.05  # Regions below this share of the largest one's area are discarded


def matte_of_file(path: Path, pixels: Pixels) -> np.ndarray:
    """Read a matte from an image: its alpha, labels, or grey values of 8 or 16 bits.

    An alpha channel is used unless it is constant. All labels except 0 are the subject; a single larger
    value in addition to labels is void. A mask of another size is scaled.

    Args:
        path: the mask file.
        pixels: the photograph; the mask fits it as shown or as stored.

    Returns:
        [h, w] uint8, for the photograph as shown.

    Raises:
        InputError: the mask cannot be decoded, or fits the photograph neither as shown nor as stored.
    """
    image = read_image(path)
    values = np.asarray(image)
    if image.mode in ("LA", "RGBA"):
        alpha = values[..., -1]
        values = alpha if alpha.min() < alpha.max() else values[..., :-1]
    require(values.dtype.kind in "bui", str(path), "a mask of whole numbers", values.dtype)
    values = values if values.ndim == 2 else values.max(-1)
    most = int(values.max(initial=0))
    labelled = (values > 0) & (values < _LABELS)
    # Void is a thin rim; a soft matte has values between the labels and the largest value.
    is_void = (values == most).sum() < labelled.sum() and not ((values >= _LABELS) & (values < most)).any()
    if most < _LABELS or is_void:
        return fit_to_photograph(labelled * np.uint8(255), pixels, path)
    return fit_to_photograph(np.round(values * (1 / 257 if most > 255 else 1)).astype(np.uint8), pixels, path)


def fit_to_photograph(matte: np.ndarray, pixels: Pixels, path: Path) -> np.ndarray:
    """Rotate and scale a matte to its photograph.

    Args:
        matte: [h, w] uint8, for the photograph as shown or as stored, at any size.
        pixels: the photograph as shown.
        path: file of the matte, for the message.

    Returns:
        [h, w] uint8, for the photograph as shown.

    Raises:
        InputError: the aspect ratio differs from that of the photograph.
    """
    sizes = (pixels.size, pixels.stored_size)
    alike = [size for size in sizes if size == matte.shape] or [
        s for s in sizes if same_ratio(s, matte.shape)
    ]
    expected = f"the size of its photograph, {pixels.size} (height, width), or its aspect ratio"
    require(bool(alike), str(path), expected, matte.shape)
    matte = matte if alike[0] == pixels.size else np.rot90(matte, pixels.turns)
    if matte.shape == pixels.size:
        return matte
    return np.asarray(Image.fromarray(matte).resize(pixels.size[::-1], Image.Resampling.BILINEAR))


def matte_of_background(pixels: Pixels, path: Path) -> np.ndarray:
    """Segment what differs from a photograph of the background.

    Args:
        pixels: the photograph with the subject.
        path: a photograph by the same camera without the subject.

    Returns:
        [h, w] uint8, 0 or 255, without specks and holes.

    Raises:
        InputError: the background has another size, or nothing differs.
    """
    from scipy import ndimage  # here: not needed for masks from files

    background = read_pixels(path)
    fits = background.size == pixels.size
    require(fits, str(path), f"the size of the photograph, {pixels.size} (height, width)", background.size)
    difference = np.abs(pixels.image.astype(np.float32) - background.image).max(-1)
    # Most pixels show the background: 1.48 times the median estimates the noise's standard deviation.
    threshold = max(_DEVIATIONS * 1.4826 * float(np.median(difference)), _LEAST_DIFFERENCE)
    radius = max(max(pixels.size) // 400, 1)
    regions, count = ndimage.label(ndimage.binary_opening(difference > threshold, iterations=radius))
    require(count > 0, str(path), "a background that differs from the photograph", "no difference")
    areas = np.bincount(regions.ravel())
    areas[0] = 0
    subject = (areas >= _SPECK * areas.max())[regions]
    radius *= 2
    closed = ndimage.binary_closing(np.pad(subject, radius), iterations=radius)
    return ndimage.binary_fill_holes(closed[radius:-radius, radius:-radius]) * np.uint8(255)


def segmenter(name: str) -> Callable[[Pixels], np.ndarray]:
    """Create a segmenter, which keeps its network loaded.

    Args:
        name: one of :data:`SEGMENTERS`.

    Returns:
        A function from photographs to mattes [h, w] uint8.

    Raises:
        InputError: the name is unknown, or the package is not installed.
    """
    require_choice("segment", name, SEGMENTERS)
    rembg = import_optional("rembg", "segment", "segment")
    session = rembg.new_session()

    def matte(pixels: Pixels) -> np.ndarray:
        alpha = rembg.remove(Image.fromarray(pixels.image), session=session, only_mask=True)
        return np.asarray(alpha.convert("L"))

    return matte


def mask_path(photograph: Path, images: Path, masks: Path) -> Path | None:
    """Find the mask of a photograph: at the same relative path in ``masks``, or named ``<name>_mask``.

    Args:
        photograph: a path below ``images``.
        images: folder of the photographs.
        masks: folder of the masks; may be ``images``.

    Returns:
        The path, or None.
    """
    # Not resolved: photographs may be links to files elsewhere.
    folder = masks / photograph.parent.relative_to(images)
    marked = f"{photograph.stem}{MASK_ENDING}"
    # In the photograph's folder, the image of the same name is the photograph itself.
    is_same_folder = os.path.realpath(folder) == os.path.realpath(photograph.parent)
    # COLMAP's masks keep the suffix of the photograph: front.jpg.png.
    names = [marked] if is_same_folder else [photograph.stem, photograph.name, marked]
    return find_image(folder, *names) or find_similar_mask(folder, photograph.stem, is_same_folder)
