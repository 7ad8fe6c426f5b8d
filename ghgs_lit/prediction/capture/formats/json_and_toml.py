"""This package's JSON, OpenCV's matrices as JSON, and the TOML of Pose2Sim and Anipose."""

import json
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ghgs_lit.data.decoding import check_array
from ghgs_lit.errors import InputError, require
from ghgs_lit.files import write_text_atomically
from ghgs_lit.prediction.capture.calibration import Calibration, Convention, StoredCamera
from ghgs_lit.prediction.capture.formats.camera_file import CameraFile, by_name
from ghgs_lit.prediction.capture.formats.fields import OPENCV, camera_from_fields, is_camera, size_from_fields
from ghgs_lit.prediction.export.maps import camera_entry, cameras_json


def read_json_file(path: Path) -> dict[str, Any]:
    """The object of a JSON file.

    Raises:
        InputError: it is none.
    """
    try:
        found = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: expected JSON; found {error}") from error
    require(isinstance(found, dict), str(path), "a JSON object", type(found).__name__)
    return found


def read_json(path: Path) -> CameraFile:
    """``{"cameras": {<name>: {...}}}``, or that mapping alone, with the keys of one of two kinds.

    ``intrinsics`` [3, 3], ``extrinsics`` [4, 4] or [3, 4], ``width``, ``height``, ``distortion`` and
    ``fisheye``: this package's conventions (:mod:`ghgs_lit.types`); only the first two must be there.
    ``K``, ``R``, ``T``, ``D``: OpenCV's.

    Raises:
        InputError: a camera is missing or wrong.
    """
    content = read_json_file(path)
    named = content.get("cameras", content)
    require(isinstance(named, dict), f"{path}: cameras", "cameras by name", type(named).__name__)
    own = {name: c for name, c in named.items() if isinstance(c, Mapping) and "extrinsics" in c}
    if own:
        cameras = [_own(name, f"{path}: {name}", camera) for name, camera in own.items()]
        return CameraFile(by_name(cameras), Convention(), "ghgs")
    return _of_opencv(path, named, "opencv")


def read_toml(path: Path) -> CameraFile:
    """Pose2Sim's and Anipose's TOML: a table for each camera, named by its key ``name``.

    Raises:
        InputError: a camera is missing or wrong.
    """
    try:
        tables = tomllib.loads(path.read_text())
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise InputError(f"{path}: expected TOML; found {error}") from error
    named = {str(t.get("name", key)): t for key, t in tables.items() if isinstance(t, dict)}
    return _of_opencv(path, named, "toml")


def _of_opencv(path: Path, named: Mapping[str, Any], name_of_format: str) -> CameraFile:
    found = {name: camera for name, camera in named.items() if is_camera(camera)}
    require(bool(found), str(path), "cameras with intrinsics and extrinsics (or K, R and T)", sorted(named))
    cameras = [camera_from_fields(name, f"{path}: {name}", camera) for name, camera in found.items()]
    return CameraFile(by_name(cameras), OPENCV, name_of_format)


def _own(name: str, place: str, camera: Mapping[str, Any]) -> StoredCamera:
    known = ("intrinsics", "extrinsics", "width", "height", "distortion", "fisheye")
    unknown = sorted(set(camera) - set(known))
    require(not unknown, place, f"keys among {', '.join(known)}", unknown)
    require("intrinsics" in camera, place, "intrinsics", sorted(camera))
    pose = check_array(f"{place}: extrinsics", camera["extrinsics"], [(4, 4), (3, 4)])
    distortion = check_array(f"{place}: distortion", camera.get("distortion", []), [(None,)])
    fisheye = bool(camera.get("fisheye", False))
    return StoredCamera(
        name, place, camera["intrinsics"], pose, size_from_fields(place, camera), distortion, fisheye
    )


def write_json(path: Path, cameras: Mapping[str, tuple[Calibration, tuple[int, int]]]) -> None:
    """Write cameras and the (height, width) of their photographs as :func:`read_json` reads them."""
    entries = {
        name: camera_entry(camera.intrinsics, camera.extrinsics, size)
        | {"distortion": camera.distortion.tolist(), "fisheye": camera.fisheye}
        for name, (camera, size) in cameras.items()
    }
    write_text_atomically(path, cameras_json(entries) + "\n")
