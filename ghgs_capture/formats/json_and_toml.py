"""This package's JSON, OpenCV's matrices as JSON, and the TOML of Pose2Sim,
Anipose and Caliscope."""

import json
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ghgs_capture.calibration import Calibration, Convention, StoredCamera
from ghgs_capture.formats import opencv
from ghgs_capture.formats.camera_file import CameraFile, read_mapping
from ghgs_capture.formats.entries import Entries
from ghgs_lit.errors import require


def read_json_file(path: Path) -> dict[str, Any]:
    """The object of a JSON file.

    Args:
        path: of the file.

    Returns:
        The object.

    Raises:
        InputError: there is none, or it has a key twice, of which JSON keeps the last.
    """
    return read_mapping(path, lambda text: json.loads(text, object_pairs_hook=_once), "JSON", "a JSON object")


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    content = dict(pairs)
    if len(content) < len(pairs):
        names = [key for key, _ in pairs]
        raise ValueError(f"the key {next(key for key in names if names.count(key) > 1)!r} twice")
    return content


def read_json(path: Path) -> CameraFile:
    """``{"cameras": {<name>: {...}}}``, or that mapping alone, with the keys of one of two kinds.

    ``intrinsics`` [3, 3], ``extrinsics`` [4, 4] or [3, 4], ``width``, ``height``, ``distortion``,
    ``fisheye`` and ``gains``: this package's conventions (:mod:`ghgs_lit.types`); only the first
    two must be there. ``K``, ``R``, ``T``, ``D``: OpenCV's.

    Args:
        path: of the file.

    Returns:
        The cameras by name.

    Raises:
        InputError: a camera is missing or wrong.
    """
    content = read_json_file(path)
    named = _cameras_of(path, content)
    with_extrinsics = {n: c for n, c in named.items() if isinstance(c, Mapping) and "extrinsics" in c}
    if not with_extrinsics:
        return _read_matrices(path, content, named, "opencv")
    cameras = [_camera(name, f"{path}: {name}", camera) for name, camera in with_extrinsics.items()]
    unread = _others(path, content, named, with_extrinsics)
    return CameraFile.of(cameras, Convention(), "ghgs", unread)


def _cameras_of(path: Path, content: Mapping[str, Any]) -> dict[str, Any]:
    """Cameras by name: those of the entry ``cameras``, a mapping or a list,
    or all entries without one."""
    named = content.get("cameras", content)
    if isinstance(named, list) and all(isinstance(camera, Mapping) for camera in named):
        named = {str(camera.get("name", i)): camera for i, camera in enumerate(named)}
    require(isinstance(named, dict), f"{path}: cameras", "cameras by name", type(named).__name__)
    return named


def _others(
    path: Path, content: Mapping[str, Any], named: Mapping[str, Any], read: Mapping[str, Any]
) -> list[str]:
    """Entries of a file that are no cameras.

    Args:
        path: of the file, for messages.
        content: all of the file.
        named: what may be cameras, by name.
        read: the cameras among them that are read.

    Returns:
        Keys of the others, of ``named`` and beside the entry ``cameras``.

    Raises:
        InputError: one says something of the lens.
    """
    below = {name: value for name, value in named.items() if name not in read}
    outside = {key: value for key, value in content.items() if "cameras" in content}
    unread = []
    for fields in (below, outside):
        unread += Entries(str(path), fields).unread(opencv.IRRELEVANT)
    return unread


def read_toml(path: Path) -> CameraFile:
    """Pose2Sim's, Anipose's and Caliscope's TOML: a table for each camera,
    named by its key ``name``.

    Args:
        path: of the file.

    Returns:
        The cameras by name.

    Raises:
        InputError: a camera is missing or wrong.
    """
    content = read_mapping(path, tomllib.loads, "TOML", "TOML")
    tables = _cameras_of(path, content)
    named: dict[str, Any] = {}
    for key, table in tables.items():
        name = str(table.get("name", key)) if isinstance(table, dict) else key
        require(name not in named, f"{path}: {key}", "a name that no other table has", name)
        named[name] = table
    return _read_matrices(path, content, named, "toml")


def _read_matrices(
    path: Path, content: Mapping[str, Any], named: Mapping[str, Any], name_of_format: str
) -> CameraFile:
    """Cameras with OpenCV's matrices, and a warning about other entries.

    Args:
        path: of the file.
        content: all of the file.
        named: what may be cameras, by name; those without a camera matrix are none.
        name_of_format: one of :data:`ghgs_capture.formats.FORMATS`.

    Returns:
        The cameras by name.

    Raises:
        InputError: a camera is missing or wrong.
    """
    expected = "cameras with intrinsics and extrinsics (or K, R and T)"
    with_intrinsics = {name: camera for name, camera in named.items() if opencv.has_intrinsics(camera)}
    cameras = opencv.cameras_from_fields(path, with_intrinsics, expected, sorted(named))
    unread = _others(path, content, named, with_intrinsics)
    return CameraFile.of(cameras, Convention(pixel_centers="integer"), name_of_format, unread)


def _camera(name: str, origin: str, camera: Mapping[str, Any]) -> StoredCamera:
    entries = Entries(origin, camera)
    pose = np.eye(4)
    extrinsics = entries.needed("extrinsics", (4, 4), (3, 4))
    pose[: len(extrinsics)] = extrinsics
    return opencv.camera_of(name, entries, pose)


def json_text(cameras: Mapping[str, tuple[Calibration, tuple[int, int]]]) -> str:
    """Cameras as text that :func:`read_json` reads.

    Args:
        cameras: each with the (height, width) of its photographs in pixels.

    Returns:
        The content of a file.
    """
    from ghgs_capture.export.maps import camera_entry, cameras_json  # here: it imports PyTorch

    entries = {
        name: camera_entry(camera.intrinsics, camera.extrinsics, size)
        | {"distortion": camera.distortion.tolist(), "fisheye": camera.fisheye}
        | ({} if camera.gains is None else {"gains": camera.gains.tolist()})
        for name, (camera, size) in cameras.items()
    }
    return cameras_json(entries) + "\n"
