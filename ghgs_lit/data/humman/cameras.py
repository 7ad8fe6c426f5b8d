"""``cameras.json`` of a HuMMan sequence: ten colour and ten depth cameras.

Each has ``K`` (3, 3), ``R`` (3, 3) and ``T`` (3), OpenCV's, world to camera in metres, without lens
distortion. The world is the frame of ``kinect_color_000``: y points down.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ghgs_lit.data.decoding import check_array, check_extrinsics, check_intrinsics
from ghgs_lit.errors import InputError
from ghgs_lit.readers import read_json

KINECTS = range(10)
# Metres: least and greatest plausible distance between cameras of one studio.
_NEAREST, _FURTHEST = 0.1, 100.0


@dataclass(frozen=True)
class Calibration:
    """Ten cameras. ``intrinsics``: [10, 3, 3] in pixels, pixel centres at integers. ``extrinsics``: [10, 4,
    4], world to camera, metres."""

    intrinsics: np.ndarray
    extrinsics: np.ndarray


def read_calibration(path: Path, kind: str) -> Calibration:
    """Read the cameras of a sequence. ``kind``: ``color`` or ``depth``. InputError: it is missing or broken,
    a camera is missing or bad, or translations are not in metres."""
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
