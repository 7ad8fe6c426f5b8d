"""Cameras of a file, and what the readers of all formats share."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ghgs_lit.errors import InputError, require
from ghgs_lit.prediction.capture.calibration import Convention, StoredCamera

_SUFFIXES = ("jpg", "jpeg", "png", "tif", "tiff", "bmp", "webp")


@dataclass(frozen=True)
class CameraFile:
    """The cameras of a file by name, the meaning of their numbers by its format, and the format's name."""

    cameras: dict[str, StoredCamera]
    convention: Convention
    format: str

    @classmethod
    def of(cls, cameras: Sequence[StoredCamera], convention: Convention, format: str) -> "CameraFile":
        """Cameras in their order; names of photographs lose folder and suffix, where they still differ."""
        short = [_stem(camera.name) for camera in cameras]
        names = short if len(set(short)) == len(short) else [camera.name for camera in cameras]
        return cls(dict(zip(names, cameras, strict=True)), convention, format)


def _stem(name: str) -> str:
    last = name.replace("\\", "/").rpartition("/")[2]
    stem, dot, suffix = last.rpartition(".")
    return stem if dot and suffix.lower() in _SUFFIXES else last


def read_mapping(path: Path, parse: Callable[[str], Any], kind: str, content: str) -> dict[str, Any]:
    """The mapping that a file of text holds.

    Args:
        path: of the file.
        parse: of its text.
        kind, content: of such files, for messages.

    Raises:
        InputError: the file cannot be read or parsed, or holds something else.
    """
    try:
        value = parse(path.read_text())
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path}: expected {kind}; found {error}") from error
    require(isinstance(value, dict), str(path), content, type(value).__name__)
    return value


def pinhole(fx: float, fy: float, cx: float, cy: float) -> np.ndarray:
    """Intrinsics [3, 3] of focal lengths and a principal point in pixels."""
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], np.float64)


def coefficients(numbers: Mapping[str, float], names: str) -> np.ndarray:
    """Distortion coefficients in the order of ``names``, 0 where they are missing; none if all are 0."""
    values = np.array([numbers.get(name, 0.0) for name in names.split()])
    return values if values.any() else np.zeros(0)
