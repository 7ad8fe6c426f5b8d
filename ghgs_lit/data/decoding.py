"""Files of data sets, decoded and checked: every defect is an :class:`InputError` that names the file."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from ghgs_lit.errors import InputError, require

# How far from the image's centre a principal point may lie, as a fraction of the side.
_OFF_CENTRE = 0.25
_SAFE_NAME = re.compile(r"[\w.+-]+")

Shapes = Sequence[tuple[int | None, ...]]


def read_image(path: Path) -> Image.Image:
    """Decode an image.

    Raises:
        InputError: it is missing or cannot be decoded.
    """
    if not path.exists():
        raise InputError(f"{path}: expected an image; found no such file")
    try:
        image = Image.open(path)
        image.load()
    except (OSError, SyntaxError, Image.DecompressionBombError) as error:
        raise InputError(f"{path}: expected a readable image; found {error}") from error
    return image


def to_rgb(image: Image.Image) -> np.ndarray:
    """[h, w, 3] uint8 from an image of any mode."""
    return np.asarray(image if image.mode == "RGB" else image.convert("RGB"))


def read_map(path: Path, size: tuple[int, int]) -> np.ndarray:
    """Read channel 0 of a mask or depth map.

    Args:
        path: the image file.
        size: (height, width) of its photograph, which it must have too.

    Raises:
        InputError: it is missing, cannot be decoded, or has another size.
    """
    array = np.asarray(read_image(path))
    if array.shape[:2] != size:
        raise InputError(
            f"{path}: expected the size of its photograph, {size[0]}x{size[1]}; "
            f"found {array.shape[0]}x{array.shape[1]}"
        )
    return array if array.ndim == 2 else array[..., 0]


def read_array(path: Path, shapes: Shapes) -> np.ndarray:
    """Read a finite float64 array from an ``.npy`` file; arguments and errors as :func:`check_array`."""
    if not path.exists():
        raise InputError(f"{path}: expected an array {_describe(shapes)}; found no such file")
    try:
        array = np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError, TypeError) as error:
        raise InputError(
            f"{path}: expected an array {_describe(shapes)}; found a file that cannot be read: {error}"
        ) from error
    return check_array(path, array, shapes)


def check_array(place: Path | str, array: Any, shapes: Shapes) -> np.ndarray:
    """Convert to a finite float64 array.

    Args:
        place: the file, or the file and key, for messages.
        array: anything that NumPy takes.
        shapes: the shapes that are accepted; None is any length.

    Raises:
        InputError: it is not an array of numbers, has another shape, or is not finite.
    """
    try:
        array = np.asarray(array).astype(np.float64)
    except (ValueError, TypeError) as error:
        raise InputError(f"{place}: expected an array {_describe(shapes)}; found {error}") from error
    fits = any(
        array.ndim == len(shape) and all(s in (None, a) for s, a in zip(shape, array.shape, strict=True))
        for shape in shapes
    )
    if not fits:
        found = "x".join(map(str, array.shape))
        raise InputError(f"{place}: expected an array {_describe(shapes)}; found {found}")
    if not np.isfinite(array).all():
        raise InputError(f"{place}: expected finite numbers; found NaN or infinity")
    return array


def _describe(shapes: Shapes) -> str:
    return " or ".join("x".join("n" if s is None else str(s) for s in shape) for shape in shapes)


def check_intrinsics(place: Path | str, intrinsics: Any) -> np.ndarray:
    """Finite intrinsics [3, 3] with focal lengths above 0, float64.

    Raises:
        InputError: they are not; it names ``place``.
    """
    intrinsics = check_array(place, intrinsics, [(3, 3)])
    if min(intrinsics[0, 0], intrinsics[1, 1]) <= 0:
        raise InputError(
            f"{place}: expected focal lengths above 0; found {intrinsics[0, 0]}, {intrinsics[1, 1]}"
        )
    return intrinsics


def check_extrinsics(place: Path | str, extrinsics: Any) -> np.ndarray:
    """Extrinsics [4, 4] float64 from [3, 4] or [4, 4], world to camera: finite, with a proper rotation.

    Raises:
        InputError: they are not; it names ``place``.
    """
    extrinsics = np.concatenate((check_array(place, extrinsics, [(3, 4), (4, 4)])[:3], [[0, 0, 0, 1]]))
    rotation = extrinsics[:3, :3]
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-2 or np.linalg.det(rotation) < 0:
        found = np.round(rotation, 3).tolist()
        raise InputError(f"{place}: expected a rotation in the first three columns; found {found}")
    return extrinsics


def check_center(path: Path, intrinsics: np.ndarray, height: int, width: int) -> None:
    """Refuse a photograph that was resized after its calibration.

    Args:
        path: the photograph, for messages.
        intrinsics: [3, 3] in pixels of the calibration.
        height, width: size of the photograph in pixels.

    Raises:
        InputError: the principal point lies far from the photograph's centre.
    """
    if np.abs(intrinsics[:2, 2] / [width, height] - 0.5).max() > _OFF_CENTRE:
        raise InputError(
            f"{path}: expected a photograph of the calibration's size, its principal point "
            f"{intrinsics[0, 2]:.0f}, {intrinsics[1, 2]:.0f} near the centre; found {height}x{width}"
        )


def check_name(name: str) -> str:
    """Return ``name`` if it can be a part of a file name (results and pictures are named after subjects)."""
    require(bool(_SAFE_NAME.fullmatch(name)), "subject", "letters, digits and . + - _ only", name)
    return name
