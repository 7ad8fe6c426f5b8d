"""Read ``transforms.json`` of nerfstudio and Instant NGP: camera-to-world matrices, OpenGL axes."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ghgs_capture.calibration import Convention, PartialIntrinsics, StoredCamera
from ghgs_capture.formats.entries import FISHEYE, CameraFile, Entries
from ghgs_capture.formats.matrices import read_mapping
from ghgs_lit.errors import require
from ghgs_lit.parsing import find_path

# Entries that are irrelevant for a camera, as normalised by :func:`plain`
_IRRELEVANT = (
    *("frames", "aabbscale", "scale", "offset", "appliedtransform", "appliedscale", "orientationoverride"),
    *("plyfilepath", "depthfilepath", "colmapimid", "sharpness", "rotation", "time", "up"),
    *("trainfilenames", "valfilenames", "testfilenames"),
)


def read_nerfstudio(path: Path) -> CameraFile:
    """Read the cameras of ``frames``; intrinsics of a frame override those of the file.

    Format: https://docs.nerf.studio/quickstart/data_conventions.html.

    Returns:
        Cameras named after their photographs.

    Raises:
        InputError: there are no frames, or a frame is invalid.
    """
    content = read_mapping(path)
    frames = content.get("frames")
    require(isinstance(frames, list) and len(frames) > 0, f"{path}: frames", "a list of frames", frames)
    cameras = [_read_camera(path, f"{path}: frames[{i}]", content, frame) for i, frame in enumerate(frames)]
    convention = Convention(extrinsics="camera_to_world", axes="opengl")
    return CameraFile.of(cameras, convention)


def _read_camera(path: Path, origin: str, shared: Mapping[str, Any], frame: Any) -> StoredCamera:
    """Read the camera of one frame from its entries and those ``shared`` by all frames; masks are
    searched relative to the file's folder."""
    require(isinstance(frame, Mapping), origin, "a mapping", frame)
    entries = Entries(origin, {**shared, **frame})
    photograph = entries.text("file_path")
    mask = entries.text("mask_path")
    require(photograph is not None, origin, "file_path", sorted(frame))
    pose = entries.needed("transform_matrix", (4, 4), (3, 4))
    size = entries.size
    fisheye = entries.is_fisheye
    lens = _read_lens(entries)
    is_known = size is not None or lens.is_known
    return StoredCamera(
        photograph,
        origin,
        lens.intrinsics(size or (0, 0)) if is_known else np.eye(3),
        pose,
        size,
        distortion=entries.distortion(FISHEYE if fisheye else "k1 k2 p1 p2 k3"),
        fisheye=fisheye,
        mask=None if mask is None else find_path(path.parent, mask) or path.parent / mask,
        lens=None if is_known else lens,
        unread=entries.unread(_IRRELEVANT),
    )


def _read_lens(entries: Entries) -> PartialIntrinsics:
    """Read the intrinsics; raises InputError without a focal length or angle of view, or for an angle
    outside of 0 to pi."""
    focal = entries.number("fl_x"), entries.number("fl_y")
    middle = entries.number("cx"), entries.number("cy")
    angles = entries.number("camera_angle_x"), entries.number("camera_angle_y")
    is_enough = any(value is not None for value in (*focal, *angles))
    require(is_enough, entries.origin, "fl_x or camera_angle_x", sorted(entries.fields))
    for axis, angle in zip("xy", angles, strict=True):
        is_angle = angle is None or 0 < angle < math.pi
        require(is_angle, f"{entries.origin}: camera_angle_{axis}", "radians between 0 and pi", angle)
    return PartialIntrinsics(focal, middle, angles)
