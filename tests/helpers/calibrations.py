"""Calibration files as written by other programs."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from ghgs_capture.calibration import StoredCamera
from ghgs_capture.formats import read_cameras

CAMERA = {"K": [[1000, 0, 320], [0, 1000, 240], [0, 0, 1]], "R": np.eye(3).tolist(), "T": [0, 0, 3]}
LENS = [-0.35, 0.12, 0.001, -0.0005, 0.01]


def write(path: Path, content: Any) -> Path:
    """Write text, or any other content as JSON."""
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def one_camera(tmp_path: Path, **entries: Any) -> StoredCamera:
    """Read a camera of OpenCV matrices with further entries from a file."""
    return read_cameras(write(tmp_path / "cameras.json", {"a": CAMERA | entries})).cameras["a"]


def frame(name: str, **entries: Any) -> dict[str, Any]:
    """A frame of transforms.json."""
    return {"file_path": name, "transform_matrix": np.eye(4).tolist()} | entries


def transforms(tmp_path: Path, *frames: dict[str, Any], **entries: Any) -> Path:
    """Write a file transforms.json."""
    content = {"fl_x": 500, "cx": 320, "cy": 240, "w": 640, "h": 480, "frames": frames} | entries
    return write(tmp_path / "transforms.json", content)
