"""OpenCV's YAML (``cv2.FileStorage``): a file for each camera, all cameras in one, or EasyMocap's pair."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from ghgs_lit.errors import InputError, require
from ghgs_lit.prediction.capture.formats.camera_file import CameraFile, by_name
from ghgs_lit.prediction.capture.formats.fields import OPENCV, camera_from_fields, is_camera

#: The files of EasyMocap: intrinsics and poses.
EASYMOCAP = ("intri.yml", "extri.yml")
# Its keys carry the camera's name: K_01, dist_01, R_01 (vector), Rot_01 (matrix), T_01.
_WITH_NAME = re.compile(r"(K|dist|D|R|Rot|T|H|W)_(.+)")


class _Loader(yaml.SafeLoader):
    """YAML with OpenCV's tag for matrices."""


def _matrix(loader: _Loader, node: yaml.Node) -> np.ndarray:
    """The node ``{rows, cols, dt, data}``, or ``{sizes, dt, data}`` as OpenCV 5 writes arrays of one axis."""
    fields = loader.construct_mapping(node, deep=True)
    sizes = fields["sizes"] if "sizes" in fields else (fields["rows"], fields["cols"])
    return np.array(fields["data"], np.float64).reshape(tuple(map(int, sizes)))


for _name in ("opencv-matrix", "opencv-nd-matrix"):
    _Loader.add_constructor(f"tag:yaml.org,2002:{_name}", _matrix)


def read_yaml(path: Path) -> dict[str, Any]:
    """The mapping of a YAML file of ``cv2.FileStorage``.

    Raises:
        InputError: it is no such file.
    """
    try:
        # OpenCV writes "%YAML:1.0", which is not a directive of YAML.
        text = re.sub(r"\A%YAML[^\n]*\n", "", path.read_text())
        found = yaml.load(text, _Loader)
    except (OSError, UnicodeDecodeError, yaml.YAMLError, KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: expected YAML of OpenCV; found {error}") from error
    require(isinstance(found, dict), str(path), "YAML of OpenCV with named matrices", type(found).__name__)
    return found


def read_opencv(path: Path) -> CameraFile:
    """Cameras of a YAML file, or of all YAML files of a folder.

    Raises:
        InputError: a camera is missing or wrong.
    """
    files = sorted([*path.glob("*.yml"), *path.glob("*.yaml")]) if path.is_dir() else [path]
    cameras = [camera for file in files for camera in _cameras(file)]
    return CameraFile(by_name(cameras), OPENCV, "opencv")


def _cameras(file: Path) -> list:
    """Cameras of one file: of its mappings, of keys with names, or the one that the whole file is."""
    fields = read_yaml(file)
    if is_camera(fields):
        return [camera_from_fields(file.stem, str(file), fields)]
    named = {name: value for name, value in fields.items() if is_camera(value)} or _split(fields)
    require(bool(named), str(file), "a camera matrix (camera_matrix, K or K_<name>)", sorted(fields))
    return [camera_from_fields(name, f"{file}: {name}", value) for name, value in named.items()]


def _split(fields: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Cameras whose keys carry their names."""
    found: dict[str, dict[str, Any]] = {}
    for key, value in fields.items():
        if match := _WITH_NAME.fullmatch(key):
            found.setdefault(match[2], {})[match[1]] = value
    return {name: camera for name, camera in found.items() if is_camera(camera)}


def read_easymocap(path: Path) -> CameraFile:
    """EasyMocap's ``intri.yml`` and ``extri.yml``, by the path of one of them or of their folder.

    Raises:
        InputError: one of the files is missing, or a camera is wrong.
    """
    folder = path if path.is_dir() else path.parent
    fields: dict[str, Any] = {}
    for name in EASYMOCAP:
        require(
            (folder / name).exists(), str(folder / name), "EasyMocap's file beside the other", "no such file"
        )
        fields |= read_yaml(folder / name)
    named = _split(fields)
    require(bool(named), str(folder / EASYMOCAP[0]), "camera matrices K_<name>", sorted(fields))
    cameras = [camera_from_fields(name, f"{folder}: {name}", camera) for name, camera in named.items()]
    return CameraFile(by_name(cameras), OPENCV, "easymocap")
