"""Points of the performer's surface from the depth cameras: a replacement for the vertices of a body."""

from pathlib import Path

import numpy as np

from ghgs_lit.data.decoding import read_image
from ghgs_lit.data.humman.cameras import KINECTS, Calibration
from ghgs_lit.errors import InputError

MILLIMETRES = 1000.0
_FURTHEST = 5.0  # metres: the limit of the data set's own toolbox, too
# Number of points that are kept, evenly over the cameras: a multiple of what a loss uses.
_KEPT = 20000


def surface_points(
    sequence: Path, frame: int, depth_cameras: Calibration, cameras: Calibration, masks: dict[int, np.ndarray]
) -> np.ndarray:
    """What the depth cameras see inside all masks. ``masks``: [h, w] bool by number of the colour camera.
    Returns: [n, 3] float32 in the world, metres. InputError: a depth map is missing or bad, or no point lies
    inside the masks."""
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
    rows, columns = np.nonzero((z > 0) & (z < _FURTHEST))
    z = z[rows, columns]
    pixels = np.stack((columns * z, rows * z, z), -1)  # the calibration puts pixel centres at integers
    pose = cameras.extrinsics[kinect]
    return (pixels @ np.linalg.inv(cameras.intrinsics[kinect]).T - pose[:3, 3]) @ pose[:3, :3]


def _inside(
    points: np.ndarray, kinect: int, cameras: Calibration, masks: dict[int, np.ndarray]
) -> np.ndarray:
    """Points that no mask excludes and one includes; the own camera comes first: it excludes the most."""
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
