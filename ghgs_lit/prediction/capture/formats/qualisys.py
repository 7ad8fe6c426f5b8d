"""Qualisys' ``.qca.txt``: XML with millimetres, 1/64 pixels, and the axes of OpenGL."""

import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np

from ghgs_lit.errors import InputError, require
from ghgs_lit.prediction.capture.calibration import Convention, StoredCamera
from ghgs_lit.prediction.capture.formats.camera_file import CameraFile, coefficients, pinhole

_SUBPIXELS = 64
_COEFFICIENTS = {
    **{f"k{i}": f"radialDistortion{i}" for i in (1, 2, 3)},
    **{f"p{i}": f"tangentalDistortion{i}" for i in (1, 2)},
}


def read_qualisys(path: Path) -> CameraFile:
    """The cameras by their serial numbers; results are in metres.

    Raises:
        InputError: it is no such file, or an entry is missing or no number.
    """
    try:
        # Python's XML reader itself limits entities that grow.
        cameras = list(ElementTree.parse(path).getroot().iter("camera"))
    except (OSError, ElementTree.ParseError) as error:
        raise InputError(f"{path}: expected Qualisys' XML; found {error}") from error
    require(bool(cameras), str(path), "cameras of Qualisys", "none")
    convention = Convention(axes="opengl", pixel_centers="integer", unit=0.001)
    return CameraFile.of([_camera(path, camera) for camera in cameras], convention, "qualisys")


def _camera(path: Path, camera: ElementTree.Element) -> StoredCamera:
    name = camera.get("serial", "")
    origin = f"{path}: {name}"

    def numbers(element: str, *keys: str) -> list[float]:
        node = camera.find(element)
        require(node is not None, origin, element, [child.tag for child in camera])
        try:
            return [float(node.get(key, "missing")) for key in keys]
        except ValueError:
            expected = f"numbers {', '.join(keys)}"
            raise InputError(f"{origin}: {element}: expected {expected}; found {node.attrib}") from None

    left, top, right, bottom = numbers("fov_video", "left", "top", "right", "bottom")
    keys = ("focalLengthU", "focalLengthV", "centerPointU", "centerPointV")
    fx, fy, cx, cy = (value / _SUBPIXELS for value in numbers("intrinsic", *keys))
    values = numbers("intrinsic", *_COEFFICIENTS.values())
    distortion = coefficients(dict(zip(_COEFFICIENTS, values, strict=True)), "k1 k2 p1 p2 k3")
    pose = np.eye(4)
    turn = [f"r{row}{column}" for row in (1, 2, 3) for column in (1, 2, 3)]
    pose[:3, :3] = np.reshape(numbers("transform", *turn), (3, 3))
    pose[:3, 3] = -pose[:3, :3] @ numbers("transform", "x", "y", "z")
    size = int(bottom - top) + 1, int(right - left) + 1
    return StoredCamera(name, origin, pinhole(fx, fy, cx - left, cy - top), pose, size, distortion)
