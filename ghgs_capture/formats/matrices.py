"""Read cameras stored as named matrices: this package's JSON, and OpenCV's as YAML, JSON or TOML.

YAML of ``cv2.FileStorage`` has a file for each camera, one file for all, or EasyMocap's two files. TOML is
written by Pose2Sim, Anipose and Caliscope. Files differ in spelling:
``camera_matrix`` or ``K``, ``distortion_coefficients`` or ``dist``, ``rvec`` or ``R``. OpenCV's poses map
the world to the camera; pixel centres are at integers."""

import json
import re
import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from ghgs_capture.calibration import Convention, StoredCamera
from ghgs_capture.formats.entries import FISHEYE, PERSPECTIVE, CameraFile, Entries
from ghgs_lit.errors import require
from ghgs_lit.parsing import check_yaml, find_path, read_parsed

EASYMOCAP = ("intri.yml", "extri.yml")  #: The files of EasyMocap: intrinsics and poses
_VECTORS = (3,), (3, 1), (1, 3)


class _Loader(yaml.SafeLoader):
    """YAML loader with OpenCV's tag for matrices; keys remain text, since 01 is the name of a camera."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode) and not key.tag.endswith(":merge"):
                key.tag = self.DEFAULT_SCALAR_TAG
        return super().construct_mapping(node, deep)


def _construct_matrix(loader: _Loader, node: yaml.Node) -> np.ndarray:
    """Construct an array from ``{rows, cols, dt, data}``, or from ``{sizes, dt, data}``, as which OpenCV 5
    writes arrays with one axis."""
    fields = loader.construct_mapping(node, deep=True)
    sizes = fields["sizes"] if "sizes" in fields else (fields["rows"], fields["cols"])
    return np.array(fields["data"], np.float64).reshape(tuple(map(int, sizes)))


for _name in ("opencv-matrix", "opencv-nd-matrix"):
    _Loader.add_constructor(f"tag:yaml.org,2002:{_name}", _construct_matrix)


def _parse_yaml(text: str) -> Any:
    text = re.sub(r"\A%YAML[^\n]*\n", "", text)  # OpenCV's "%YAML:1.0" is not a valid directive
    check_yaml(text)
    return yaml.load(text, _Loader)


def _require_unique_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    content = dict(pairs)
    if len(content) < len(pairs):
        names = [key for key, _ in pairs]
        raise ValueError(f"the key {next(key for key in names if names.count(key) > 1)!r} twice")
    return content


def _parse_json(text: str) -> Any:
    return json.loads(text, object_pairs_hook=_require_unique_keys)


#: By suffix: the parser, and a description for messages
_KINDS = {
    ".json": (_parse_json, "JSON"),
    ".toml": (tomllib.loads, "TOML"),
    "": (_parse_yaml, "YAML of OpenCV"),
}


def read_mapping(path: Path) -> dict[str, Any]:
    """Parse a file of JSON, TOML or else YAML.

    Returns:
        The mapping in the file.

    Raises:
        InputError: the file cannot be read or parsed, is not a mapping, or is JSON with a duplicate key.
    """
    kind = next(ending for ending in _KINDS if path.name.lower().endswith(ending))
    parse, expected = _KINDS[kind]
    content = read_parsed(path, expected, parse)
    require(isinstance(content, dict), str(path), f"{expected} with named entries", type(content).__name__)
    return content


def list_yaml(folder: Path) -> list[Path]:
    """YAML files of a folder, sorted by name."""
    return [path for path in sorted(folder.iterdir()) if path.suffix.lower() in (".yml", ".yaml")]


def read_matrices(path: Path) -> CameraFile:
    """Read cameras from a file, from all YAML files of a folder, or from EasyMocap's two files.

    This package's JSON is ``{"cameras": {<name>: {...}}}``, or only the inner mapping, with ``intrinsics``
    [3, 3], ``extrinsics`` [4, 4] or [3, 4], ``width``, ``height``, ``distortion`` and
    ``fisheye`` in the conventions of :mod:`ghgs_lit.types`; only the first two are required. Other cameras
    have OpenCV's ``K``, ``R``, ``T``, ``D``.

    Args:
        path: the file or folder.

    Returns:
        The cameras, named after their files or entries.

    Raises:
        InputError: a camera or file is missing or invalid.
    """
    cameras: list[StoredCamera] = []
    unread: list[str] = []
    convention = Convention(pixel_centers="integer")
    for file, content in _read_contents(path):
        named = _list_cameras(file, content)
        own = {}
        if file.suffix.lower() == ".json":
            own = {n: c for n, c in named.items() if isinstance(c, Mapping) and "extrinsics" in c}
            convention = Convention() if own else convention
        read = own or {name: camera for name, camera in named.items() if _has_intrinsics(camera)}
        others = {name: camera for name, camera in named.items() if name not in read}
        if not read:
            read, others = _split_by_suffix(content)
        expected = "cameras with intrinsics and extrinsics (or K, R and T)"
        require(bool(read), str(file), expected, sorted(content))
        cameras += [read_camera(name, Entries(f"{file}: {name}", camera)) for name, camera in read.items()]
        for fields in (others, content if "cameras" in content else {}):
            unread += Entries(str(file), fields).unread()
    return CameraFile.of(cameras, convention, unread)


def _read_contents(path: Path) -> Iterator[tuple[Path, dict[str, Any]]]:
    """Yield each file with its mapping; EasyMocap's two files are merged."""
    folder = path if path.is_dir() else path.parent
    is_pair = find_path(folder, EASYMOCAP[0]) is not None if path.is_dir() else path.name.lower() in EASYMOCAP
    if not is_pair:
        for file in list_yaml(path) if path.is_dir() else [path]:
            yield file, read_mapping(file)
        return
    fields: dict[str, Any] = {}
    for name in EASYMOCAP:
        file = find_path(folder, name)
        require(file is not None, str(folder / name), "EasyMocap's file beside the other", "no such file")
        fields |= read_mapping(file)
    yield folder, fields


def _list_cameras(path: Path, content: Mapping[str, Any]) -> dict[str, Any]:
    """Possible cameras by name: the file itself, those of the entry ``cameras`` (a mapping or a list), or
    all entries; tables of TOML are named by their key ``name``."""
    if _has_intrinsics(content):
        return {path.stem: content}
    cameras = content.get("cameras", content)
    if isinstance(cameras, list) and all(isinstance(camera, Mapping) for camera in cameras):
        cameras = {str(camera.get("name", i)): camera for i, camera in enumerate(cameras)}
    require(isinstance(cameras, dict), f"{path}: cameras", "cameras by name", type(cameras).__name__)
    if path.suffix.lower() != ".toml":
        return cameras
    named: dict[str, Any] = {}
    for key, table in cameras.items():
        name = str(table.get("name", key)) if isinstance(table, dict) else key
        require(name not in named, f"{path}: {key}", "a name that no other table has", name)
        named[name] = table
    return named


def _split_by_suffix(fields: Mapping[str, Any]) -> tuple[dict[str, dict[str, Any]], dict[str, Any]]:
    """Group entries by the camera in their suffix (K_01, dist_01, R_01 vector, Rot_01 matrix, T_01), and
    return them with the remaining entries."""
    cameras: dict[str, dict[str, Any]] = {key[2:]: {} for key in fields if key.startswith("K_")}
    others: dict[str, Any] = {}
    for key, value in fields.items():
        # The longest matching name: a file may contain both K_1 and K_cam_1.
        name = max((name for name in cameras if key.endswith(f"_{name}")), key=len, default="")
        field = key.removesuffix(f"_{name}")
        # In EasyVolcap, t is a time.
        cameras.get(name, others)["time" if field == "t" else field] = value
    return cameras, others


def _has_intrinsics(fields: Any) -> bool:
    return isinstance(fields, Mapping) and bool(Entries("", fields).keys("intrinsics"))


def read_camera(name: str, entries: Entries) -> StoredCamera:
    """Read a camera with matrices under any usual names; its rotation is a matrix or a rotation vector.

    Args:
        name: name of the camera.
        entries: its entries, with a pose as extrinsics or as rotation and translation.

    Raises:
        InputError: an entry is missing or invalid.
    """
    pose = np.eye(4)
    if entries.keys("extrinsics"):
        extrinsics = entries.needed("extrinsics", (4, 4), (3, 4))
        pose[: len(extrinsics)] = extrinsics
    else:
        pose[:3, :3] = _read_rotation(entries)
        pose[:3, 3] = entries.needed("translation", *_VECTORS).ravel()
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
        unread=entries.unread(),
    )


def _read_rotation(entries: Entries) -> np.ndarray:
    """Read the rotation [3, 3], preferably from a matrix; a vector in addition also counts as read."""
    vector = entries.array("rotation", *_VECTORS) if entries.has("rotation", *_VECTORS) else None
    if vector is None or entries.has("rotation", (3, 3)):
        return entries.needed("rotation", (3, 3))
    from scipy.spatial.transform import Rotation  # here: the import takes 50 ms, for rare files

    return Rotation.from_rotvec(vector.ravel()).as_matrix()


def camera_entry(intrinsics: Any, extrinsics: Any, size: tuple[int, int]) -> dict[str, Any]:
    """Convert a camera to plain data for this package's JSON.

    Args:
        intrinsics: array or tensor [3, 3] in pixels.
        extrinsics: array or tensor [4, 4], world to camera.
        size: (height, width) of its photograph in pixels.
    """
    matrices = {"intrinsics": intrinsics.tolist(), "extrinsics": extrinsics.tolist()}
    return {**matrices, "width": size[1], "height": size[0]}


def cameras_json(entries: Mapping[str, dict[str, Any]]) -> str:
    """Serialise entries of :func:`camera_entry`, by name, as this package's JSON."""
    return json.dumps({"cameras": entries}, indent=1)
