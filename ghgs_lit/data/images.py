"""Opening of images: which formats, the colours that their profile means,
and how they are turned."""

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

if TYPE_CHECKING:  # most photographs have no profile
    from PIL import ImageCms

#: Formats that are opened, by content: each is decoded in this process. Pillow knows others, and
#: starts a program of the system for some of them (EPS: Ghostscript).
FORMATS = ("JPEG", "PNG", "WEBP", "TIFF", "BMP", "AVIF", "GIF", "JPEG2000", "PPM", "TGA")
#: Modes that convert to RGB without loss of range.
EIGHT_BITS = ("1", "L", "LA", "P", "PA", "RGB", "RGBA", "RGBX", "CMYK", "YCbCr")
UPRIGHT = 1  #: The EXIF orientation of images that are stored as they are shown
# Colour spaces of profiles: the mode that they describe, and modes that convert to it.
# Palettes are of RGB.
_SPACES = {
    "RGB": ("RGB", ("RGB", "RGBA", "RGBX", "P", "PA", "YCbCr", "1", "L", "LA")),
    "GRAY": ("L", ("1", "L", "LA")),
    "CMYK": ("CMYK", ("CMYK",)),
}
# Levels by which a profile of sRGB may differ from LittleCMS's:
# each of two conversions rounds once.
_ROUNDING = 2


def read_image(path: Path) -> Image.Image:
    """Decode an image of :data:`FORMATS`.

    Args:
        path: of the file; the format follows from its content.

    Raises:
        InputError: it is missing or cannot be decoded.
    """
    require_file(path, "an image")
    try:
        image = Image.open(path, formats=FORMATS)
        image.load()
    except Exception as error:  # broken images raise anything
        raise InputError(f"{path}: expected a readable image; found {error}") from error
    return image


@contextlib.contextmanager
def listed_formats() -> Iterator[None]:
    """Inside, Pillow opens images of :data:`FORMATS` alone, also where a library opens them."""
    Image.init()
    known = list(Image.ID)
    Image.ID[:] = [name for name in FORMATS if name in Image.OPEN]
    try:
        yield
    finally:
        Image.ID[:] = known


def orientation_of(image: Image.Image, path: Path) -> int:
    """The EXIF orientation, 1 to 8 (CIPA DC-008).

    Any other value, such as 0, means unknown: viewers show such images as they are
    stored. A warning where EXIF data is damaged.

    Args:
        image: as opened.
        path: for the warning.
    """
    try:
        orientation = image.getexif().get(ExifTags.Base.Orientation, UPRIGHT)
    except Exception as error:  # broken entries raise anything
        warnings.warn(f"{path}: expected EXIF data; found {error!r}: shown as it is stored", stacklevel=2)
        return UPRIGHT
    return int(orientation) if orientation in range(1, 9) else UPRIGHT


def rgb_of(image: Image.Image, path: Path) -> np.ndarray:
    """Colours in sRGB of a photograph, alpha ignored.

    An embedded profile, such as Display P3 or a linear one, is applied by LittleCMS. A warning
    where it cannot be read or is of other pixels: colours are taken as sRGB.

    Args:
        image: as opened.
        path: for messages.

    Returns:
        [h, w, 3] uint8.

    Raises:
        InputError: the image has not 8 bits a channel (:data:`EIGHT_BITS`).
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
    """Mode that an ICC profile describes, and the transform to sRGB (None: the identity); ValueError: the
    profile is of other pixels."""
    from PIL import ImageCms

    opened = ImageCms.ImageCmsProfile(io.BytesIO(profile))
    space = opened.profile.xcolor_space.strip()
    described, fitting = _SPACES.get(space, ("", ()))
    if mode not in fitting:
        raise ValueError(f"a profile of {space} for pixels of mode {mode}")
    transform = ImageCms.buildTransform(opened, ImageCms.createProfile("sRGB"), described, "RGB")
    if described == "CMYK":
        return described, transform
    # All combinations of 18 levels.
    levels = np.arange(0, 256, 15, np.uint8)
    colors = np.stack(np.meshgrid(levels, levels, levels), -1).reshape(1, -1, 3)
    probe = Image.fromarray(colors if described == "RGB" else np.arange(256, dtype=np.uint8)[None])
    change = np.abs(np.int16(transform.apply(probe)) - np.int16(probe.convert("RGB"))).max()
    return described, transform if change > _ROUNDING else None
