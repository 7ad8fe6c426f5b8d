"""This package's JSON, OpenCV's matrices as JSON, and the TOML of Pose2Sim, Anipose and Caliscope."""

import json
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ghgs_lit.data.decoding import check_array
from ghgs_lit.errors import require
from ghgs_lit.prediction.capture.calibration import Calibration, Convention, StoredCamera
from ghgs_lit.prediction.capture.formats import opencv
from ghgs_lit.prediction.capture.formats.camera_file import CameraFile, check_unread, read_mapping

_KEYS = ("intrinsics", "extrinsics", "width", "height", "distortion", "fisheye", "gains")


def read_json_file(path: Path) -> dict[str, Any]:
    """The object of a JSON file. InputError: it is none."""
    return read_mapping(path, json.loads, "JSON", "a JSON object")


def read_json(path: Path) -> CameraFile:
    """``{"cameras": {<name>: {...}}}``, or that mapping alone, with the keys of one of two kinds.

    ``intrinsics`` [3, 3], ``extrinsics`` [4, 4] or [3, 4], ``width``, ``height``, ``distortion``, ``fisheye``
    and ``gains``: this package's conventions (:mod:`ghgs_lit.types`); only the first two must be there.
    ``K``, ``R``, ``T``, ``D``: OpenCV's. InputError: a camera is missing or wrong."""
    content = read_json_file(path)
    named = _cameras_of(path, content)
    with_extrinsics = {n: c for n, c in named.items() if isinstance(c, Mapping) and "extrinsics" in c}
    if not with_extrinsics:
        return _read_matrices(path, named, "opencv")
    check_unread(str(path), {n: c for n, c in named.items() if n not in with_extrinsics}, opencv.KNOWN)
    cameras = [_camera(name, f"{path}: {name}", camera) for name, camera in with_extrinsics.items()]
    return CameraFile.of(cameras, Convention(), "ghgs")


def _cameras_of(path: Path, content: Mapping[str, Any]) -> dict[str, Any]:
    """Cameras by name: those of the entry ``cameras``, a mapping or a list, or all entries without one."""
    named = content.get("cameras", content)
    if isinstance(named, list) and all(isinstance(camera, Mapping) for camera in named):
        named = {str(camera.get("name", i)): camera for i, camera in enumerate(named)}
    require(isinstance(named, dict), f"{path}: cameras", "cameras by name", type(named).__name__)
    if "cameras" in content:
        check_unread(str(path), content, opencv.KNOWN)
    return named


def read_toml(path: Path) -> CameraFile:
    """Pose2Sim's, Anipose's and Caliscope's TOML: a table for each camera, named by its key ``name``.
    InputError: a camera is missing or wrong."""
    tables = _cameras_of(path, read_mapping(path, tomllib.loads, "TOML", "TOML"))
    named = {str(t.get("name", key)): t for key, t in tables.items() if isinstance(t, dict)}
    return _read_matrices(path, named, "toml")


def _read_matrices(path: Path, named: Mapping[str, Any], name_of_format: str) -> CameraFile:
    expected = "cameras with intrinsics and extrinsics (or K, R and T)"
    with_intrinsics = {name: camera for name, camera in named.items() if opencv.has_intrinsics(camera)}
    cameras = opencv.cameras_from_fields(path, with_intrinsics, expected, sorted(named))
    check_unread(str(path), {n: c for n, c in named.items() if n not in with_intrinsics}, opencv.KNOWN)
    return CameraFile.of(cameras, Convention(pixel_centers="integer"), name_of_format)


def _camera(name: str, origin: str, camera: Mapping[str, Any]) -> StoredCamera:
    unknown = sorted(set(camera) - set(_KEYS))
    require(not unknown, origin, f"keys among {', '.join(_KEYS)}", unknown)
    require("intrinsics" in camera, origin, "intrinsics", sorted(camera))
    pose = check_array(f"{origin}: extrinsics", camera["extrinsics"], [(4, 4), (3, 4)])
    distortion = check_array(f"{origin}: distortion", camera.get("distortion", []), [(None,)])
    size, fisheye = opencv.size_from_fields(origin, camera), bool(camera.get("fisheye", False))
    lens, gains = camera["intrinsics"], camera.get("gains")
    return StoredCamera(name, origin, lens, pose, size, distortion, fisheye, gains=gains)


def json_text(cameras: Mapping[str, tuple[Calibration, tuple[int, int]]]) -> str:
    """Cameras and the (height, width) of their photographs as :func:`read_json` reads them."""
    from ghgs_lit.prediction.export.maps import camera_entry, cameras_json  # here: it imports PyTorch

    entries = {
        name: camera_entry(camera.intrinsics, camera.extrinsics, size)
        | {"distortion": camera.distortion.tolist(), "fisheye": camera.fisheye}
        | ({} if camera.gains is None else {"gains": camera.gains.tolist()})
        for name, (camera, size) in cameras.items()
    }
    return cameras_json(entries) + "\n"
