"""OpenCV's matrices under the names that programs give them, and the YAML that has them.

YAML of ``cv2.FileStorage`` is a file for each camera, all cameras in one, or EasyMocap's pair. Files differ
in spelling: ``camera_matrix`` or ``K``, ``distortion_coefficients`` or ``dist``, ``rvec`` or ``R``. Poses map
the world to the camera; pixel centres are at integers."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from ghgs_lit.data.decoding import check_array
from ghgs_lit.errors import InputError, require
from ghgs_lit.prediction.capture.calibration import Convention, StoredCamera
from ghgs_lit.prediction.capture.formats import camera_file
from ghgs_lit.readers import check_yaml

EASYMOCAP = ("intri.yml", "extri.yml")  #: The files of EasyMocap: intrinsics and poses
# Spelled as `plain` does; a rotation matrix is preferred to a vector where there are both.
_NAMES = {
    "intrinsics": ("k", "cameramatrix", "matrix", "intrinsicmatrix", "intrinsic", "intrinsics", "m"),
    "distortion": ("d", "dist", "distortion", "dists", "distortions", "lensdistortion", "kc"),
    "rotation": ("rot", "rotationmatrix", "r", "rvec", "rotation", "rotationvector"),
    "translation": ("t", "tvec", "translation", "translationvector"),
    "size": ("size", "imagesize", "imgsize", "resolution"),
    "width": ("width", "imagewidth", "w"),
    "height": ("height", "imageheight", "h"),
    "fisheye": ("fisheye", "isfisheye", "usefisheye", "fisheyemodel"),
}
_SINGLE = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")  # Coefficients with an entry each
#: Entries that are read, or irrelevant for a camera.
KNOWN = {
    *(name for names in _NAMES.values() for name in names),
    *_SINGLE,
    *("name", "names", "id", "camid", "port", "serial", "rotationcount", "error", "exposure", "gridcount"),
    *("ignore", "verifiedresolutions", "rectifyalpha", "metadata", "cameras"),
    *("time", "n", "f", "v", "ccm", "bounds"),
}


class _Loader(yaml.SafeLoader):
    """YAML with OpenCV's tag for matrices, and keys that stay text: 01 is the name of a camera."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode) and not key.tag.endswith(":merge"):
                key.tag = self.DEFAULT_SCALAR_TAG
        return super().construct_mapping(node, deep)


def _matrix(loader: _Loader, node: yaml.Node) -> np.ndarray:
    """The node ``{rows, cols, dt, data}``, or ``{sizes, dt, data}`` as OpenCV 5 writes arrays of one axis."""
    fields = loader.construct_mapping(node, deep=True)
    sizes = fields["sizes"] if "sizes" in fields else (fields["rows"], fields["cols"])
    return np.array(fields["data"], np.float64).reshape(tuple(map(int, sizes)))


for _name in ("opencv-matrix", "opencv-nd-matrix"):
    _Loader.add_constructor(f"tag:yaml.org,2002:{_name}", _matrix)


def read_opencv(path: Path) -> camera_file.CameraFile:
    """Cameras of a YAML file, or of all YAML files of a folder. InputError: a camera is missing or wrong."""
    files = sorted([*path.glob("*.yml"), *path.glob("*.yaml")]) if path.is_dir() else [path]
    cameras: list[StoredCamera] = []
    for file in files:
        fields = _read_yaml(file)
        if has_intrinsics(fields):
            cameras.append(camera_from_fields(file.stem, str(file), fields))
        else:
            named = {name: value for name, value in fields.items() if has_intrinsics(value)}
            named = named or _by_name(str(file), fields)
            expected = "a camera matrix (camera_matrix, K or K_<name>)"
            cameras += cameras_from_fields(file, named, expected, sorted(fields))
    return camera_file.CameraFile.of(cameras, Convention(pixel_centers="integer"), "opencv")


def read_easymocap(path: Path) -> camera_file.CameraFile:
    """EasyMocap's ``intri.yml`` and ``extri.yml``, by the path of one of them or of their folder. InputError:
    one of the files is missing, or a camera is wrong."""
    folder = path if path.is_dir() else path.parent
    fields: dict[str, Any] = {}
    for file in (folder / name for name in EASYMOCAP):
        require(file.exists(), str(file), "EasyMocap's file beside the other", "no such file")
        fields |= _read_yaml(file)
    named = _by_name(str(folder), fields)
    require(bool(named), str(folder / EASYMOCAP[0]), "camera matrices K_<name>", sorted(fields))
    cameras = [camera_from_fields(name, f"{folder}: {name}", camera) for name, camera in named.items()]
    return camera_file.CameraFile.of(cameras, Convention(pixel_centers="integer"), "easymocap")


def _read_yaml(path: Path) -> dict[str, Any]:

    def parse(text: str) -> Any:
        # OpenCV writes "%YAML:1.0", which is not a directive of YAML.
        text = re.sub(r"\A%YAML[^\n]*\n", "", text)
        check_yaml(text)
        return yaml.load(text, _Loader)

    return camera_file.read_mapping(path, parse, "YAML of OpenCV", "YAML of OpenCV with named matrices")


def _by_name(origin: str, fields: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Cameras whose keys carry their names: K_01, dist_01, R_01 (vector), Rot_01 (matrix), T_01."""
    cameras: dict[str, dict[str, Any]] = {key[2:]: {} for key in fields if key.startswith("K_")}
    others: dict[str, Any] = {}
    for key, value in fields.items():
        # The longest name: K_1 beside K_cam_1.
        name = max((name for name in cameras if key.endswith(f"_{name}")), key=len, default="")
        field = key.removesuffix(f"_{name}")
        cameras.get(name, others)["time" if field == "t" else field] = value  # EasyVolcap's t is a time
    camera_file.check_unread(origin, others, KNOWN)
    return cameras


def cameras_from_fields(
    path: Path, named: Mapping[str, Any], expected: str, keys: list[str]
) -> list[StoredCamera]:
    """The cameras of a file. InputError: none (names ``expected`` and ``keys``), or one is wrong."""
    require(bool(named), str(path), expected, keys)
    return [camera_from_fields(name, f"{path}: {name}", camera) for name, camera in named.items()]


def find(fields: Mapping[str, Any], what: str) -> Any:
    """The value of an entry of ``_NAMES``; None where no spelling of it is there."""
    spelled = {camera_file.plain(key): value for key, value in fields.items()}
    return next((spelled[name] for name in _NAMES[what] if name in spelled), None)


def has_intrinsics(fields: Any) -> bool:
    """Whether this is a mapping with a camera matrix."""
    return isinstance(fields, Mapping) and find(fields, "intrinsics") is not None


def camera_from_fields(name: str, origin: str, fields: Mapping[str, Any]) -> StoredCamera:
    """The camera in ``fields``, under any of ``_NAMES``. InputError: a matrix is missing or wrong."""

    def array(what: str, *shapes: tuple[int | None, ...]) -> np.ndarray:
        value, names = find(fields, what), " or ".join(_NAMES[what])
        require(value is not None, origin, f"{what} ({names})", sorted(fields))
        return check_array(f"{origin}: {what}", value, shapes)

    rotation = array("rotation", (3, 3), (3,), (3, 1), (1, 3))
    if rotation.size == 3:
        from scipy.spatial.transform import Rotation  # here: a twentieth of a second for rare files

        rotation = Rotation.from_rotvec(rotation.ravel()).as_matrix()
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = array("translation", (3,), (3, 1), (1, 3)).ravel()
    intrinsics, size = array("intrinsics", (3, 3)), size_from_fields(origin, fields)
    fisheye = find(fields, "fisheye")
    require(fisheye in (None, 0, 1), f"{origin}: fisheye", "true or false", fisheye)
    if find(fields, "distortion") is not None:
        distortion = array("distortion", (None,), (None, 1), (1, None)).ravel()
    else:
        spelled = {camera_file.plain(key): value for key, value in fields.items()}
        single = {key: value for key, value in spelled.items() if key in _SINGLE}
        numbers = {key: camera_file.finite(origin, key, value) for key, value in single.items()}
        distortion = camera_file.coefficients(numbers, "k1 k2 k3 k4" if fisheye else " ".join(_SINGLE))
    camera_file.check_unread(origin, fields, KNOWN)
    return StoredCamera(name, origin, intrinsics, pose, size, distortion, bool(fisheye))


def size_from_fields(origin: str, fields: Mapping[str, Any]) -> tuple[int, int] | None:
    """(height, width) where they are given, as two numbers or as a list (width, height)."""
    width, height = find(fields, "width"), find(fields, "height")
    if (both := find(fields, "size")) is not None:
        width, height = check_array(f"{origin}: size", both, [(2,), (2, 1), (1, 2)]).ravel()
    if width is None or height is None:
        return None
    try:
        return int(height), int(width)
    except (TypeError, ValueError):
        found = f"{width!r}, {height!r}"
        raise InputError(f"{origin}: expected width and height in pixels; found {found}") from None
