"""Cameras as mappings of OpenCV's matrices, under the names that programs give them.

Files of this kind are alike but for the spelling: ``camera_matrix`` or ``K``, ``distortion_coefficients`` or
``dist``, ``rvec`` or ``R``. Poses map the world to the camera, pixel centres are at integers.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from ghgs_lit.data.decoding import check_array
from ghgs_lit.errors import InputError, require
from ghgs_lit.prediction.capture.calibration import Convention, StoredCamera

#: What all these files mean.
OPENCV = Convention(pixel_centers="integer")

# Spelled without case and underscores; a rotation matrix is preferred to a vector where there are both.
_NAMES = {
    "intrinsics": ("k", "cameramatrix", "matrix", "intrinsicmatrix", "intrinsic", "intrinsics", "m"),
    "distortion": ("d", "dist", "distortioncoefficients", "distcoeffs", "distortions", "distortion"),
    "rotation": ("rot", "rotationmatrix", "r", "rvec", "rotation", "rotationvector"),
    "translation": ("t", "tvec", "translation", "translationvector"),
    "size": ("size", "imagesize", "imgsize"),
    "width": ("width", "imagewidth", "w"),
    "height": ("height", "imageheight", "h"),
    "fisheye": ("fisheye",),
}


def find(fields: Mapping[str, Any], what: str) -> Any:
    """The value of an entry of ``_NAMES``; None where no spelling of it is there."""
    spelled = {key.lower().replace("_", ""): value for key, value in fields.items()}
    return next((spelled[name] for name in _NAMES[what] if name in spelled), None)


def is_camera(fields: Any) -> bool:
    """Whether ``fields`` is a mapping with a camera matrix."""
    return isinstance(fields, Mapping) and find(fields, "intrinsics") is not None


def camera_from_fields(name: str, place: str, fields: Mapping[str, Any]) -> StoredCamera:
    """The camera that ``fields`` describe.

    Args:
        name: of the camera.
        place: file and key, for messages.
        fields: matrices, lists and numbers by any of their names.

    Raises:
        InputError: a matrix is missing, or is none.
    """

    def array(what: str, *shapes: tuple[int | None, ...]) -> np.ndarray:
        value, names = find(fields, what), " or ".join(_NAMES[what])
        require(value is not None, place, f"{what} ({names})", sorted(fields))
        return check_array(f"{place}: {what}", value, shapes)

    rotation = array("rotation", (3, 3), (3,), (3, 1), (1, 3))
    if rotation.size == 3:
        rotation = Rotation.from_rotvec(rotation.ravel()).as_matrix()
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = array("translation", (3,), (3, 1), (1, 3)).ravel()
    no_distortion = find(fields, "distortion") is None
    distortion = np.zeros(0) if no_distortion else array("distortion", (None,), (None, 1), (1, None)).ravel()
    intrinsics, fisheye = array("intrinsics", (3, 3)), bool(find(fields, "fisheye"))
    return StoredCamera(name, place, intrinsics, pose, size_from_fields(place, fields), distortion, fisheye)


def size_from_fields(place: str, fields: Mapping[str, Any]) -> tuple[int, int] | None:
    """(height, width) where they are given, as two numbers or as a list (width, height)."""
    width, height = find(fields, "width"), find(fields, "height")
    if (both := find(fields, "size")) is not None:
        width, height = check_array(f"{place}: size", both, [(2,), (2, 1), (1, 2)]).ravel()
    if width is None or height is None:
        return None
    try:
        size = int(height), int(width)
    except (TypeError, ValueError):
        raise InputError(
            f"{place}: expected width and height in pixels; found {width!r}, {height!r}"
        ) from None
    require(min(size) > 0, place, "a width and a height above 0", size)
    return size
