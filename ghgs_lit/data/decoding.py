"""Decoding and checking of files of data sets: images with their formats, colour profiles and EXIF
orientation, and arrays. Every :class:`InputError` names the file."""

import contextlib
import functools
import io
import re
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from PIL import ExifTags, Image

from ghgs_lit.data.view import View
from ghgs_lit.errors import InputError, require
from ghgs_lit.parsing import read_npy, require_file

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

# Maximum distance of a principal point from the image's centre, as a fraction of the side.
_OFF_CENTRE = 0.25
# Maximum entry of ``R R^T - I``: allows for rounding, but not for a scale or a wrong axis.
_ROTATION_TOLERANCE = 1e-3
#: Maximum coordinate of a vertex: one kilometre in millimetres.
_FURTHEST = 1e6
# Minimum share of an image, and maximum share of its border, that a person covers.
_LEAST_SHARE = 1e-3
_MOST_BORDER = 0.5
_SAFE_NAME = re.compile(r"[\w.+-]+")

Shapes = Sequence[tuple[int | None, ...]]


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


def read_photograph(path: Path) -> np.ndarray:
    """Read a colour image.

    Args:
        path: image with 8 bits per channel: grey, palette, RGB or CMYK; alpha is ignored.

    Returns:
        [h, w, 3] uint8 in sRGB.

    Raises:
        InputError: the file is missing or cannot be decoded, has other values, or is rotated by its EXIF
            orientation.
    """
    image = read_image(path)
    turn = orientation_of(image, path)
    if turn != UPRIGHT:
        # Programs differ in whether a calibration refers to the stored or to the rotated pixels.
        raise InputError(
            f"{path}: expected a photograph that is stored as it is shown (its mask and camera fit "
            f"these pixels); found EXIF orientation {turn}"
        )
    return rgb_of(image, path)


def read_map(path: Path, size: tuple[int, int]) -> np.ndarray:
    """Read channel 0 of a mask or depth map.

    Args:
        path: image with integer values.
        size: (height, width) of the image to which it belongs.

    Returns:
        [h, w] with the stored dtype.

    Raises:
        InputError: the file is missing or cannot be decoded, has another size, or has no integers.
    """
    array = np.asarray(read_image(path))
    if array.dtype.kind not in "bui":
        raise InputError(f"{path}: expected whole numbers; found {array.dtype}")
    if array.shape[:2] != size:
        raise InputError(
            f"{path}: expected the size of its photograph, {size[0]}x{size[1]}; "
            f"found {array.shape[0]}x{array.shape[1]}"
        )
    return array if array.ndim == 2 else array[..., 0]


def read_array(path: Path, shapes: Shapes) -> np.ndarray:
    """Read an ``.npy`` file as a finite float64 array.

    Args:
        shapes: see :func:`check_array`.

    Raises:
        InputError: the file is missing; otherwise see :func:`check_array`.
    """
    return check_array(path, read_npy(path, f"an array {_describe(shapes)}"), shapes)


def read_vertices(path: Path) -> np.ndarray:
    """Read the vertices of a body or scan from an ``.npy`` file.

    Returns:
        [n, 3] float32, n >= 1.

    Raises:
        InputError: the file is missing or has another array, or a coordinate is 1e6 or more.
    """
    vertices = read_array(path, [(None, 3)])
    require(len(vertices) > 0, str(path), "vertices", "none")
    check_extent(path, vertices)
    return vertices.astype(np.float32)


def check_extent(place: Path | str, vertices: np.ndarray) -> None:
    """Reject coordinates that are implausible for a scan of a person in any unit.

    Args:
        place: file of the vertices, for the message.
        vertices: [n, 3].

    Raises:
        InputError: a coordinate is 1e6 or more.
    """
    largest = float(np.abs(vertices).max(initial=0))
    require(largest < _FURTHEST, str(place), f"coordinates below {_FURTHEST:.0e}", largest)


def check_array(place: Path | str, array: Any, shapes: Shapes) -> np.ndarray:
    """Convert numbers to a finite float64 array.

    Args:
        place: file of the array, for the message.
        array: numbers in any form that NumPy accepts.
        shapes: allowed shapes, in which None stands for any length.

    Raises:
        InputError: it is not an array of numbers, has another shape, or is not finite.
    """
    try:
        array = np.asarray(array)
        if array.dtype.kind in "cmM":
            raise TypeError(f"numbers of type {array.dtype}")
        array = array.astype(np.float64)
    except (ValueError, TypeError, OverflowError) as error:
        found = "text" if getattr(array, "dtype", None) is not None and array.dtype.kind in "SU" else error
        raise InputError(f"{place}: expected an array {_describe(shapes)}; found {found}") from error
    fits = False
    for shape in shapes:
        pairs = zip(shape, array.shape, strict=False)
        fits |= array.ndim == len(shape) and all(wanted in (None, side) for wanted, side in pairs)
    if not fits:
        found = "x".join(map(str, array.shape))
        raise InputError(f"{place}: expected an array {_describe(shapes)}; found {found}")
    if not np.isfinite(array).all():
        raise InputError(f"{place}: expected finite numbers; found NaN or infinity")
    return array


def _describe(shapes: Shapes) -> str:
    texts = []
    for shape in shapes:
        texts.append("x".join("n" if side is None else str(side) for side in shape))
    return " or ".join(texts)


def check_intrinsics(place: Path | str, intrinsics: Any) -> np.ndarray:
    """Check intrinsics and convert them to [3, 3] float64.

    Args:
        place: file of the matrix, for the message.
        intrinsics: [3, 3] in pixels.

    Raises:
        InputError: a value is not finite, a focal length is not positive, or the last row is not 0 0 1.
    """
    intrinsics = check_array(place, intrinsics, [(3, 3)])
    if min(intrinsics[0, 0], intrinsics[1, 1]) <= 0:
        raise InputError(
            f"{place}: expected focal lengths above 0; found {intrinsics[0, 0]}, {intrinsics[1, 1]}"
        )
    _check_last_row(place, intrinsics)
    return intrinsics


def check_extrinsics(place: Path | str, extrinsics: Any) -> np.ndarray:
    """Check extrinsics and convert them to [4, 4] float64.

    Args:
        place: file of the matrix, for the message.
        extrinsics: [3, 4] or [4, 4], world to camera.

    Raises:
        InputError: a value is not finite, the first three columns are not a proper rotation, or the last
            row is not 0 0 0 1.
    """
    extrinsics = check_array(place, extrinsics, [(3, 4), (4, 4)])
    if len(extrinsics) == 3:
        extrinsics = np.concatenate((extrinsics, [[0, 0, 0, 1]]))
    _check_last_row(place, extrinsics)
    rotation = extrinsics[:3, :3]
    error = np.abs(rotation @ rotation.T - np.eye(3)).max()
    is_mirrored = np.linalg.det(rotation) < 0
    if error > _ROTATION_TOLERANCE or is_mirrored:
        found = f"{'a mirrored axis in ' if is_mirrored else ''}{np.round(rotation, 3).tolist()}"
        raise InputError(f"{place}: expected a rotation in the first three columns; found {found}")
    return extrinsics


def _check_last_row(place: Path | str, matrix: np.ndarray) -> None:
    """Reject a camera matrix that is transposed or scaled as a whole."""
    expected = np.eye(len(matrix))[-1]
    if np.abs(matrix[-1] - expected).max() > 1e-6:
        raise InputError(
            f"{place}: expected the last row {expected.astype(int).tolist()}; found {matrix[-1].tolist()}"
        )


def check_view(place: Path | str, view: View) -> None:
    """Check the shapes, dtypes and camera of a :class:`View`.

    Args:
        place: name of the image, for the message.

    Raises:
        InputError: an array or the camera is wrong.
    """
    size = np.shape(view.mask)
    arrays = {"image": (view.image, (*size, 3), np.uint8), "mask": (view.mask, size, np.bool_)}
    if view.inverse_depth is not None:
        arrays["inverse_depth"] = (view.inverse_depth, size, np.uint16)
    if view.matte is not None:
        arrays["matte"] = (view.matte, size, np.uint8)
    for name, (array, shape, dtype) in arrays.items():
        if len(size) != 2 or np.shape(array) != shape or getattr(array, "dtype", None) != dtype:
            expected = f"{dtype.__name__} of {'x'.join(map(str, shape))}"
            found = (
                f"{getattr(array, 'dtype', type(array).__name__)} of {'x'.join(map(str, np.shape(array)))}"
            )
            raise InputError(f"{place}: {name}: expected {expected}; found {found}")
    check_intrinsics(f"{place}: intrinsics", view.intrinsics)
    check_extrinsics(f"{place}: extrinsics", view.extrinsics)


def check_mask(place: Path | str, mask: np.ndarray) -> None:
    """Check a mask, [h, w] bool and true on the subject.

    Raises:
        InputError: the subject is too small, or the mask is full or inverted.
    """
    border = np.concatenate((mask[0], mask[-1], mask[:, 0], mask[:, -1])).mean()
    if border > _MOST_BORDER:
        expected = "a mask of the subject, not of the background"
        raise InputError(f"{place}: expected {expected}; found {border:.0%} of the border in it")
    if mask.mean() < _LEAST_SHARE:
        expected = f"a subject of {_LEAST_SHARE:.1%} of the photograph or more"
        raise InputError(f"{place}: expected {expected}; found {mask.sum()} pixels")


def check_center(path: Path, intrinsics: np.ndarray, height: int, width: int) -> None:
    """Reject an image that was resized after its calibration.

    Args:
        path: the image, for the message.
        intrinsics: [3, 3] in pixels.
        height: height of the image in pixels.
        width: width of the image in pixels.

    Raises:
        InputError: the principal point is farther from the centre than a quarter of a side.
    """
    if np.abs(intrinsics[:2, 2] / [width, height] - 0.5).max() > _OFF_CENTRE:
        raise InputError(
            f"{path}: expected a photograph of the calibration's size, its principal point "
            f"{intrinsics[0, 2]:.0f}, {intrinsics[1, 2]:.0f} near the centre; found {height}x{width}"
        )


def check_name(name: str) -> str:
    """Return a subject's name if it can be part of a file name, as results are named after subjects.

    Raises:
        InputError: the name has characters other than letters, digits and ``. + - _``.
    """
    require(bool(_SAFE_NAME.fullmatch(name)), "subject", "letters, digits and . + - _ only", name)
    return name
