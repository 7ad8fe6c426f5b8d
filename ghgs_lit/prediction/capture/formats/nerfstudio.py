"""``transforms.json`` of nerfstudio and Instant NGP: camera-to-world matrices with OpenGL's axes."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ghgs_lit.data.decoding import check_array
from ghgs_lit.errors import choice, require
from ghgs_lit.prediction.capture.calibration import Convention, StoredCamera
from ghgs_lit.prediction.capture.formats import camera_file
from ghgs_lit.prediction.capture.formats.json_and_toml import read_json_file

_LENS = ("k1", "k2", "k3", "k4", "p1", "p2")
_KEYS = ("fl_x", "fl_y", "cx", "cy", "w", "h", "camera_angle_x", "camera_angle_y", *_LENS)
_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV_FISHEYE")
# Read, or irrelevant for a camera.
_KNOWN = {
    *map(camera_file.plain, _KEYS),
    *("frames", "filepath", "transformmatrix", "maskpath", "cameramodel", "isfisheye", "aabbscale", "scale"),
    *("offset", "appliedtransform", "appliedscale", "orientationoverride", "plyfilepath", "depthfilepath"),
    *("colmapimid", "sharpness", "rotation", "trainfilenames", "valfilenames", "testfilenames", "time", "up"),
}


def read_nerfstudio(path: Path) -> camera_file.CameraFile:
    """Cameras of ``frames``, whose intrinsics win over those of the file. InputError: a frame is wrong."""
    content = read_json_file(path)
    frames = content.get("frames")
    require(isinstance(frames, list) and len(frames) > 0, f"{path}: frames", "a list of frames", frames)
    cameras = [_camera(path, f"{path}: frames[{i}]", content, frame) for i, frame in enumerate(frames)]
    convention = Convention(extrinsics="camera_to_world", axes="opengl")
    return camera_file.CameraFile.of(cameras, convention, "nerfstudio")


def _camera(path: Path, origin: str, shared: Mapping[str, Any], frame: Any) -> StoredCamera:
    require(isinstance(frame, Mapping), origin, "a mapping", frame)
    for key in ("file_path", "transform_matrix"):
        require(key in frame, origin, key, sorted(frame))
    fields = {**shared, **frame}
    model, flag = fields.get("camera_model"), fields.get("is_fisheye")
    choice(f"{origin}: camera_model", model, (None, *_MODELS))
    fisheye = model == "OPENCV_FISHEYE" if flag is None else bool(flag)
    allowed = (None, False, True) if model is None else (None, model == "OPENCV_FISHEYE")
    require(flag in allowed, f"{origin}: is_fisheye", f"{allowed[-1]} beside {model}", flag)
    numbers = {key: camera_file.finite(origin, key, fields[key]) for key in _KEYS if key in fields}
    size = (int(numbers["h"]), int(numbers["w"])) if {"h", "w"} <= set(numbers) else None
    intrinsics = _intrinsics(origin, numbers, size)
    names = "k1 k2 k3 k4" if fisheye else "k1 k2 p1 p2 k3"
    beyond = [key for key in _LENS if numbers.get(key) and key not in names.split()]
    require(not beyond, origin, f"distortion {names}", beyond)
    distortion = camera_file.coefficients(numbers, names)
    pose = check_array(f"{origin}: transform_matrix", frame["transform_matrix"], [(4, 4), (3, 4)])
    mask = path.parent / str(frame["mask_path"]) if frame.get("mask_path") else None
    camera_file.check_unread(origin, fields, _KNOWN)
    return StoredCamera(str(frame["file_path"]), origin, intrinsics, pose, size, distortion, fisheye, mask)


def _intrinsics(origin: str, numbers: Mapping[str, float], size: tuple[int, int] | None) -> np.ndarray:
    """Intrinsics of focal lengths or angles of view; the principal point is the middle by default."""
    height, width = size or (None, None)
    focal = {}
    for axis, side in (("x", width), ("y", height)):
        angle = numbers.get(f"camera_angle_{axis}")
        if f"fl_{axis}" in numbers:
            focal[axis] = numbers[f"fl_{axis}"]
        elif angle is not None and side is not None and 0 < angle < math.pi:
            focal[axis] = side / 2 / math.tan(angle / 2)
    is_enough = bool(focal) and (size is not None or {"cx", "cy"} <= set(numbers))
    require(is_enough, origin, "fl_x, cx and cy, or w, h and camera_angle_x", sorted(numbers))
    # Square pixels where one focal length is given.
    fx, fy = focal.get("x", focal.get("y")), focal.get("y", focal.get("x"))
    cx = numbers["cx"] if "cx" in numbers else width / 2
    cy = numbers["cy"] if "cy" in numbers else height / 2
    return camera_file.pinhole(fx, fy, cx, cy)
