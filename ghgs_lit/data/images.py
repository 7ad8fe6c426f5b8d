"""Decoding of images: formats, colour profiles and EXIF orientation."""

import contextlib
import functools
import io
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from PIL import ExifTags, Image

from ghgs_lit.errors import InputError
from ghgs_lit.parsing import require_file

if TYPE_CHECKING:  # most images have no profile
    from PIL import ImageCms

#: Formats that are opened, recognised by their content, all decoded in this process. For some of its
#: other formats Pillow would start a program of the system (EPS: Ghostscript).
FORMATS = ("JPEG", "PNG", "WEBP", "TIFF", "BMP", "AVIF", "GIF", "JPEG2000", "PPM", "TGA")
#: Pillow's modes that convert to RGB without loss of range.
EIGHT_BITS = ("1", "L", "LA", "P", "PA", "RGB", "RGBA", "RGBX", "CMYK", "YCbCr")
UPRIGHT = 1  #: EXIF orientation of images that are stored as displayed
# By the colour space of a profile: the mode that it describes, and the modes that convert to it.
# Palettes are RGB.
_SPACES = {
    "RGB": ("RGB", ("RGB", "RGBA", "RGBX", "P", "PA", "YCbCr", "1", "L", "LA")),
    "GRAY": ("L", ("1", "L", "LA")),
    "CMYK": ("CMYK", ("CMYK",)),
}
# Maximum difference in levels between an sRGB profile and LittleCMS's: two conversions round once each.
_ROUNDING = 2


def read_image(path: Path) -> Image.Image:
    """Decode an image in one of :data:`FORMATS`, recognised by its content.

    Raises:
        InputError: the file is missing or cannot be decoded.
    """
    require_file(path, "an image")
    try:
        image = Image.open(path, formats=FORMATS)
        image.load()
    except Exception as error:  # broken images raise anything
        raise InputError(f"{path}: expected a readable image; found {error}") from error
    return image


@contextlib.contextmanager
def limit_formats() -> Iterator[None]:
    """Context in which Pillow opens only images in :data:`FORMATS`, also when other libraries call it."""
    Image.init()
    known = list(Image.ID)
    Image.ID[:] = [name for name in FORMATS if name in Image.OPEN]
    try:
        yield
    finally:
        Image.ID[:] = known


def orientation_of(image: Image.Image, path: Path) -> int:
    """EXIF orientation of an image, 1 to 8 (CIPA DC-008).

    Any other value, such as 0, means unknown and gives 1, as viewers show such images as stored.
    Damaged EXIF data gives a warning.

    Args:
        path: its file, for the warning.
    """
    try:
        orientation = image.getexif().get(ExifTags.Base.Orientation, UPRIGHT)
    except Exception as error:  # broken entries raise anything
        warnings.warn(f"{path}: expected EXIF data; found {error!r}: shown as it is stored", stacklevel=2)
        return UPRIGHT
    return int(orientation) if orientation in range(1, 9) else UPRIGHT


def rgb_of(image: Image.Image, path: Path) -> np.ndarray:
    """Convert an image to sRGB; alpha is ignored.

    LittleCMS applies an embedded profile, such as Display P3 or a linear one. A profile that is damaged
    or describes other pixels gives a warning, and colours are taken as sRGB.

    Args:
        path: its file, for messages.

    Returns:
        [h, w, 3] uint8.

    Raises:
        InputError: the image does not have 8 bits per channel (:data:`EIGHT_BITS`).
    """
    if image.mode not in EIGHT_BITS:
        raise InputError(f"{path}: expected a photograph of 8 bits a channel; found mode {image.mode}")
    profile = image.info.get("icc_profile")
    if profile:
        try:
            mode, transform = _to_srgb(profile, image.mode)
            if transform is not None:
                return np.asarray(transform.apply(image if image.mode == mode else image.convert(mode)))
        except Exception as error:  # broken profiles raise anything
            found = f"{error!r}: taken as sRGB"
            warnings.warn(f"{path}: expected an ICC profile of its pixels; found {found}", stacklevel=2)
    return np.asarray(image if image.mode == "RGB" else image.convert("RGB"))


@functools.lru_cache(maxsize=64)
def _to_srgb(profile: bytes, mode: str) -> "tuple[str, ImageCms.ImageCmsTransform | None]":
    """Mode that an ICC profile describes, and the transform to sRGB (None: the identity); raises
    ValueError if the profile describes other pixels."""
    from PIL import ImageCms

    opened = ImageCms.ImageCmsProfile(io.BytesIO(profile))
    space = opened.profile.xcolor_space.strip()
    described, fitting = _SPACES.get(space, ("", ()))
    if mode not in fitting:
        raise ValueError(f"a profile of {space} for pixels of mode {mode}")
    transform = ImageCms.buildTransform(opened, ImageCms.createProfile("sRGB"), described, "RGB")
    if described == "CMYK":
        return described, transform
    # All combinations of 18 levels per channel.
    levels = np.arange(0, 256, 15, np.uint8)
    colors = np.stack(np.meshgrid(levels, levels, levels), -1).reshape(1, -1, 3)
    probe = Image.fromarray(colors if described == "RGB" else np.arange(256, dtype=np.uint8)[None])
    change = np.abs(np.int16(transform.apply(probe)) - np.int16(probe.convert("RGB"))).max()
    return described, transform if change > _ROUNDING else None
