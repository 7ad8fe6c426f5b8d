"""Qualisys' ``.qca.txt``: XML with millimetres, 1/64 pixels, and the axes of OpenGL."""

import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np

from ghgs_capture.calibration import Convention, StoredCamera
from ghgs_capture.formats.camera_file import CameraFile, pinhole
from ghgs_capture.formats.entries import Entries, coefficients
from ghgs_lit.errors import InputError, require
from ghgs_lit.parsing import require_file

_SUBPIXELS = 64
_ORDER = "k1 k2 p1 p2 k3"
_DISTORTION = {"k": "radialDistortion", "p": "tangentalDistortion"}


def read_qualisys(path: Path) -> CameraFile:
    """The cameras of Qualisys' ``.qca.txt`` by serial number.

    Args:
        path: of the file.

    Returns:
        The cameras; their lengths are millimetres.

    Raises:
        InputError: no such file, or an entry is missing or no number.
    """
    require_file(path, "cameras of Qualisys")
    try:
        cameras = [_camera(path, camera) for camera in ElementTree.parse(path).getroot().iter("camera")]
    except InputError:
        raise
    except (OSError, ElementTree.ParseError, AttributeError, KeyError, ValueError) as error:
        raise InputError(f"{path}: expected cameras of Qualisys; found {error!r}") from error
    require(bool(cameras), str(path), "cameras of Qualisys", "none")
    convention = Convention(axes="opengl", pixel_centers="integer", unit=0.001)
    return CameraFile.of(cameras, convention, "qualisys")


def _camera(path: Path, camera: ElementTree.Element) -> StoredCamera:
    """One camera; :func:`read_qualisys` names errors in it."""
    name = camera.attrib["serial"]
    numbers = {}
    for part in ("fov_video", "transform", "intrinsic"):
        numbers |= {key: float(value) for key, value in camera.find(part).attrib.items()}
    fx = numbers["focalLengthU"] / _SUBPIXELS
    fy = numbers["focalLengthV"] / _SUBPIXELS
    cx = numbers["centerPointU"] / _SUBPIXELS
    cy = numbers["centerPointV"] / _SUBPIXELS
    intrinsics = pinhole(fx, fy, cx - numbers["left"], cy - numbers["top"])
    keys = {name: f"{_DISTORTION[name[0]]}{name[1]}" for name in _ORDER.split()}
    lens = {name: numbers.get(key, 0.0) for name, key in keys.items()}
    others = {key: value for key, value in numbers.items() if key not in keys.values()}
    Entries(f"{path}: {name}", others).unread(())  # refuses distortion of other names
    pose = np.eye(4)
    for row in range(3):
        pose[row, :3] = [numbers[f"r{row + 1}{column}"] for column in (1, 2, 3)]
    pose[:3, 3] = -pose[:3, :3] @ [numbers[axis] for axis in "xyz"]
    size = int(numbers["bottom"] - numbers["top"]) + 1, int(numbers["right"] - numbers["left"]) + 1
    distortion = coefficients(lens, _ORDER)
    return StoredCamera(name, f"{path}: {name}", intrinsics, pose, size, distortion)
