"""Cameras of a file, and what the readers of all formats share."""

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ghgs_capture.calibration import Convention, StoredCamera
from ghgs_capture.photographs import PICTURES, SUFFIXES
from ghgs_lit.errors import InputError, require
from ghgs_lit.parsing import composed, parts_of, read_parsed


@dataclass(frozen=True)
class CameraFile:
    """The cameras of a file by name, the meaning of their numbers by its format,
    and the format's name."""

    cameras: dict[str, StoredCamera]
    convention: Convention
    format: str

    @classmethod
    def of(
        cls, cameras: Sequence[StoredCamera], convention: Convention, format: str, unread: Sequence[str] = ()
    ) -> "CameraFile":
        """Name cameras by their photographs, without folder and suffix, in their order.

        Where different cameras share such a name (that of an instant), all are named by their
        folders, or as the file has it. A camera that is listed for several photographs is one,
        without their masks. One warning names all entries that are not read.

        Args:
            cameras: with names as the file has them.
            convention: meaning of their numbers by the format.
            format: name of the format.
            unread: keys beside the cameras that are not read.

        Returns:
            The cameras by name.

        Raises:
            InputError: two different cameras have one name.
        """
        if unread := sorted(set(unread).union(*(camera.unread for camera in cameras))):
            warnings.warn(f"cameras: entries that are not read: {', '.join(unread)}", stacklevel=3)
        for part in (-1, -2, 0):
            named: dict[str, StoredCamera] = {}
            for camera in cameras:
                name = _parts(camera.name)[part:][0] if part else composed(camera.name)
                if name not in named:
                    named[name] = camera
                elif named[name].has_numbers_of(camera):
                    named[name] = replace(camera, mask=None)
                else:
                    break
            else:
                return cls(named, convention, format)
        raise InputError(f"{camera.origin}: expected cameras of different names; found {name} twice")


def _parts(name: str) -> list[str]:
    *folders, last = parts_of(name)
    path = Path(last)
    suffix = path.suffix.lower()
    is_picture = suffix in SUFFIXES or suffix[1:] in PICTURES.split()
    return [*folders, path.stem if is_picture else last]


def read_mapping(path: Path, parse: Callable[[str], Any], kind: str, content: str) -> dict[str, Any]:
    """The mapping in a text file.

    Args:
        path: of the file.
        parse: gives the content of a text; its errors are named with the path.
        kind: what the file should be, for messages.
        content: what it should hold, for messages.

    Returns:
        The mapping.

    Raises:
        InputError: the file cannot be read or parsed, or holds no mapping.
    """
    value = read_parsed(path, kind, parse)
    require(isinstance(value, dict), str(path), content, type(value).__name__)
    return value


def pinhole(fx: float, fy: float, cx: float, cy: float) -> np.ndarray:
    """Intrinsics of a pinhole camera.

    Args:
        fx: horizontal focal length in pixels.
        fy: vertical focal length in pixels.
        cx: column of the principal point, in pixels.
        cy: row of the principal point, in pixels.

    Returns:
        The matrix [3, 3] float64.
    """
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], np.float64)
