"""OpenCV's matrices under the names that programs give them, and the YAML that has them.

YAML of ``cv2.FileStorage`` is a file for each camera, all cameras in one, or EasyMocap's pair.
Files differ in spelling: ``camera_matrix`` or ``K``, ``distortion_coefficients`` or ``dist``,
``rvec`` or ``R``. Poses map the world to the camera; pixel centres are at integers."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from ghgs_capture.calibration import Convention, StoredCamera
from ghgs_capture.formats.camera_file import CameraFile, read_mapping
from ghgs_capture.formats.entries import FISHEYE, PERSPECTIVE, Entries
from ghgs_lit.errors import require
from ghgs_lit.parsing import check_yaml, find_path

EASYMOCAP = ("intri.yml", "extri.yml")  #: The files of EasyMocap: intrinsics and poses
#: Entries of a camera, or beside cameras, that do not matter, as :func:`plain` spells them.
IRRELEVANT = (
    *("name", "names", "id", "camid", "port", "serial", "rotationcount", "error", "exposure", "gridcount"),
    *("ignore", "verifiedresolutions", "rectifyalpha", "metadata", "cameras"),
    *("time", "n", "f", "v", "ccm", "bounds"),
)
# A matrix is preferred to a vector where there are both
_ROTATIONS = ((3, 3),), ((3,), (3, 1), (1, 3))


class _Loader(yaml.SafeLoader):
    """YAML with OpenCV's tag for matrices, and keys that stay text: 01 is the name of a camera."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode) and not key.tag.endswith(":merge"):
                key.tag = self.DEFAULT_SCALAR_TAG
        return super().construct_mapping(node, deep)


def _matrix(loader: _Loader, node: yaml.Node) -> np.ndarray:
    """The node ``{rows, cols, dt, data}``, or ``{sizes, dt, data}`` as OpenCV 5 writes arrays
    of one axis."""
    fields = loader.construct_mapping(node, deep=True)
    sizes = fields["sizes"] if "sizes" in fields else (fields["rows"], fields["cols"])
    return np.array(fields["data"], np.float64).reshape(tuple(map(int, sizes)))


for _name in ("opencv-matrix", "opencv-nd-matrix"):
    _Loader.add_constructor(f"tag:yaml.org,2002:{_name}", _matrix)


def yaml_files(folder: Path) -> list[Path]:
    """The YAML files of a folder, sorted by name.

    Args:
        folder: where they lie.
    """
    return [path for path in sorted(folder.iterdir()) if path.suffix.lower() in (".yml", ".yaml")]


def read_opencv(path: Path) -> CameraFile:
    """Cameras of a YAML file, or of all YAML files of a folder.

    Args:
        path: of the file, or of the folder.

    Returns:
        The cameras, named by their files or entries.

    Raises:
        InputError: a camera is missing or wrong.
    """
    files = yaml_files(path) if path.is_dir() else [path]
    cameras: list[StoredCamera] = []
    unread: list[str] = []
    for file in files:
        fields = _read_yaml(file)
        if has_intrinsics(fields):
            cameras.append(camera_from_fields(file.stem, str(file), fields))
            continue
        named = {name: value for name, value in fields.items() if has_intrinsics(value)}
        others = {key: value for key, value in fields.items() if key not in named}
        if not named:
            named, others = _by_name(fields)
        unread += Entries(str(file), others).unread(IRRELEVANT)
        expected = "a camera matrix (camera_matrix, K or K_<name>)"
        cameras += cameras_from_fields(file, named, expected, sorted(fields))
    return CameraFile.of(cameras, Convention(pixel_centers="integer"), "opencv", unread)


def read_easymocap(path: Path) -> CameraFile:
    """EasyMocap's ``intri.yml`` and ``extri.yml``.

    Args:
        path: of one of them, or of their folder.

    Returns:
        The cameras by name.

    Raises:
        InputError: one of the files is missing, or a camera is wrong.
    """
    folder = path if path.is_dir() else path.parent
    fields: dict[str, Any] = {}
    for name in EASYMOCAP:
        file = find_path(folder, name)
        require(file is not None, str(folder / name), "EasyMocap's file beside the other", "no such file")
        fields |= _read_yaml(file)
    named, others = _by_name(fields)
    require(bool(named), str(folder / EASYMOCAP[0]), "camera matrices K_<name>", sorted(fields))
    cameras = [camera_from_fields(name, f"{folder}: {name}", camera) for name, camera in named.items()]
    unread = Entries(str(folder), others).unread(IRRELEVANT)
    return CameraFile.of(cameras, Convention(pixel_centers="integer"), "easymocap", unread)


def _read_yaml(path: Path) -> dict[str, Any]:

    def parse(text: str) -> Any:
        # OpenCV writes "%YAML:1.0", which is not a directive of YAML.
        text = re.sub(r"\A%YAML[^\n]*\n", "", text)
        check_yaml(text)
        return yaml.load(text, _Loader)

    return read_mapping(path, parse, "YAML of OpenCV", "YAML of OpenCV with named matrices")


def _by_name(fields: Mapping[str, Any]) -> tuple[dict[str, dict[str, Any]], dict[str, Any]]:
    """Cameras whose keys carry their names: K_01, dist_01, R_01 (vector), Rot_01 (matrix), T_01;
    and the other entries."""
    cameras: dict[str, dict[str, Any]] = {key[2:]: {} for key in fields if key.startswith("K_")}
    others: dict[str, Any] = {}
    for key, value in fields.items():
        # The longest name: K_1 beside K_cam_1.
        name = max((name for name in cameras if key.endswith(f"_{name}")), key=len, default="")
        field = key.removesuffix(f"_{name}")
        # EasyVolcap's t is a time
        cameras.get(name, others)["time" if field == "t" else field] = value
    return cameras, others


def cameras_from_fields(
    path: Path, named: Mapping[str, Any], expected: str, keys: list[str]
) -> list[StoredCamera]:
    """The cameras of a file with OpenCV's matrices.

    Args:
        path: of the file, for messages.
        named: entries of each camera, by name.
        expected: what a file without cameras should have, for the message.
        keys: what that file has instead.

    Returns:
        The cameras, in their order.

    Raises:
        InputError: there is none, or one is wrong.
    """
    require(bool(named), str(path), expected, keys)
    return [camera_from_fields(name, f"{path}: {name}", camera) for name, camera in named.items()]


def has_intrinsics(fields: Any) -> bool:
    """Whether this is a mapping with a camera matrix.

    Args:
        fields: anything that a file holds.
    """
    return isinstance(fields, Mapping) and bool(Entries("", fields).keys("intrinsics"))


def camera_from_fields(name: str, origin: str, fields: Mapping[str, Any]) -> StoredCamera:
    """One camera with OpenCV's matrices, under any usual names.

    Args:
        name: of the camera.
        origin: file and camera, for messages.
        fields: its entries; a rotation is a matrix or a vector.

    Returns:
        The camera.

    Raises:
        InputError: a matrix is missing or wrong.
    """
    entries = Entries(origin, fields)
    # All are looked at, so that a vector beside a matrix counts as read.
    rotations = [
        entries.array("rotation", *shapes) for shapes in _ROTATIONS if entries.has("rotation", *shapes)
    ]
    rotation = rotations[0] if rotations else entries.needed("rotation", *_ROTATIONS[0], *_ROTATIONS[1])
    if rotation.size == 3:
        from scipy.spatial.transform import Rotation  # here: a twentieth of a second for rare files

        rotation = Rotation.from_rotvec(rotation.ravel()).as_matrix()
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = entries.needed("translation", (3,), (3, 1), (1, 3)).ravel()
    return camera_of(name, entries, pose)


def camera_of(name: str, entries: Entries, pose: np.ndarray) -> StoredCamera:
    """A camera with a known pose, all else from its entries.

    Args:
        name: of the camera.
        entries: those of the camera in its file.
        pose: [4, 4], as the file has it.

    Returns:
        The camera.

    Raises:
        InputError: an entry is missing or wrong.
    """
    intrinsics = entries.needed("intrinsics", (3, 3))
    fisheye = entries.is_fisheye
    return StoredCamera(
        name,
        entries.origin,
        intrinsics,
        pose,
        size=entries.size,
        distortion=entries.distortion(FISHEYE if fisheye else PERSPECTIVE),
        fisheye=fisheye,
        gains=entries.array("gains", (3,)),
        unread=entries.unread(IRRELEVANT),
    )
