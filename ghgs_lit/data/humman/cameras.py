"""Cameras of a HuMMan sequence (``cameras.json``), ten of colour and ten of depth, and points of the latter.

Each has ``K`` (3, 3), ``R`` (3, 3) and ``T`` (3) as in OpenCV, world to camera in metres, without lens
distortion. The world is the frame of ``kinect_color_000``: y points down.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ghgs_lit.data.decoding import check_array, check_extrinsics, check_intrinsics, read_image
from ghgs_lit.errors import InputError
from ghgs_lit.readers import read_json

KINECTS = range(10)
# Metres: least and greatest plausible distance between cameras of one studio.
_NEAREST, _FURTHEST = 0.1, 100.0


@dataclass(frozen=True)
class Calibration:
    """Ten cameras: ``intrinsics`` [10, 3, 3] with pixel centres at integers, ``extrinsics`` [10, 4, 4]."""

    intrinsics: np.ndarray
    extrinsics: np.ndarray


def read_calibration(path: Path, kind: str) -> Calibration:
    """Read the cameras of a sequence. ``kind``: ``color`` or ``depth``. InputError: the file or a camera is
    missing or bad, or translations are not in metres."""
    content = read_json(path, "the cameras of a sequence in JSON")
    cameras = [_camera(path, content, f"kinect_{kind}_{k:03d}") for k in KINECTS]
    intrinsics, extrinsics = (np.stack(matrices) for matrices in zip(*cameras, strict=True))
    centers = -np.einsum("nji,nj->ni", extrinsics[:, :3, :3], extrinsics[:, :3, 3])
    spread = np.linalg.norm(centers - centers[0], axis=-1).max()
    if not _NEAREST < spread < _FURTHEST:
        raise InputError(
            f"{path}: expected translations T in metres; found {kind} cameras {spread:.4g} m apart"
        )
    return Calibration(intrinsics, extrinsics)


def _camera(path: Path, content: Any, key: str) -> tuple[np.ndarray, np.ndarray]:
    camera = content.get(key) if isinstance(content, dict) else None
    for name in ("K", "R", "T"):
        if not isinstance(camera, dict) or name not in camera:
            raise InputError(f"{path}: expected {name} of {key}; found none")
    place = f"{path}: {key}"
    rotation = check_array(f"{place}: R", camera["R"], [(3, 3)])
    translation = check_array(f"{place}: T", camera["T"], [(3,), (3, 1)]).reshape(3, 1)
    extrinsics = check_extrinsics(place, np.concatenate((rotation, translation), 1))
    return check_intrinsics(f"{place}: K", camera["K"]), extrinsics


MILLIMETRES = 1000.0
_DEEPEST = 5.0  # metres, as in the data set's own toolbox
# Greatest number of points that are kept, evenly over the cameras.
_KEPT = 20000


def surface_points(
    sequence: Path, frame: int, depth_cameras: Calibration, cameras: Calibration, masks: dict[int, np.ndarray]
) -> np.ndarray:
    """World points [n, 3] float32 of the depth cameras that lie inside all masks. ``masks``: [h, w] bool by
    number of the colour camera. InputError: a depth map is missing or bad, or no point lies inside."""
    points = [_points(_path(sequence, k, frame), depth_cameras, k) for k in KINECTS]
    inside = [_inside(world, k, cameras, masks) for k, world in zip(KINECTS, points, strict=True)]
    found = np.concatenate(inside)
    if not len(found):
        raise InputError(
            f"{_path(sequence, 0, frame)}: expected depth of the performer; found none in the masks"
        )
    return found[:: -(-len(found) // _KEPT)].astype(np.float32)


def _path(sequence: Path, kinect: int, frame: int) -> Path:
    return sequence / "kinect_depth" / f"kinect_{kinect:03d}" / f"{frame:06d}.png"


def _points(path: Path, cameras: Calibration, kinect: int) -> np.ndarray:
    depth = np.asarray(read_image(path))
    if depth.ndim != 2 or depth.dtype == np.uint8:
        raise InputError(
            f"{path}: expected 16 bits of depth in millimetres; found {depth.dtype} {depth.shape}"
        )
    z = depth.astype(np.float64) / MILLIMETRES
    rows, columns = np.nonzero((z > 0) & (z < _DEEPEST))
    z = z[rows, columns]
    pixels = np.stack((columns * z, rows * z, z), -1)  # the calibration puts pixel centres at integers
    pose = cameras.extrinsics[kinect]
    return (pixels @ np.linalg.inv(cameras.intrinsics[kinect]).T - pose[:3, 3]) @ pose[:3, :3]


def _inside(
    points: np.ndarray, kinect: int, cameras: Calibration, masks: dict[int, np.ndarray]
) -> np.ndarray:
    """Points that some mask includes and none excludes; the own camera, which excludes most, comes first."""
    seen = np.zeros(len(points), bool)
    for k in sorted(masks, key=lambda k: k != kinect):
        pose, (height, width) = cameras.extrinsics[k], masks[k].shape
        local = points @ pose[:3, :3].T + pose[:3, 3]
        front = local[:, 2] > 1e-3
        pixels = local @ cameras.intrinsics[k].T
        places = np.where(front[:, None], pixels[:, :2] / np.where(front, pixels[:, 2], 1)[:, None], -1)
        columns, rows = np.round(places).astype(int).T
        framed = front & (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
        keep = ~framed
        keep[framed] = masks[k][rows[framed], columns[framed]]
        points, seen = points[keep], (seen | framed)[keep]
    return points[seen]
