"""Cameras of a file, and what the readers of all formats share."""

import math
import re
import unicodedata
import warnings
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ghgs_lit.errors import InputError, require
from ghgs_lit.prediction.capture.calibration import Convention, StoredCamera
from ghgs_lit.readers import read_parsed

_SUFFIXES = ("jpg", "jpeg", "png", "tif", "tiff", "bmp", "webp")
# Entries about a lens, as :func:`plain` spells them, and models that such entries may name.
_LENS = re.compile("(?<!un)dist(?!ance)|lens|radial|tangent|fisheye|model|omni|theta|^[kps][0-9]$|^xi$")
_MODELS = re.compile("fisheye|equidist|kannala|omni|spher|equirect|theta|division|panoram|orthogr|prism|fov")


@dataclass(frozen=True)
class CameraFile:
    """The cameras of a file by name, the meaning of their numbers by its format, and the format's name."""

    cameras: dict[str, StoredCamera]
    convention: Convention
    format: str

    @classmethod
    def of(cls, cameras: Sequence[StoredCamera], convention: Convention, format: str) -> "CameraFile":
        """Cameras in their order, named by their photographs without folder and suffix.

        Where different cameras share such a name (that of an instant), all are named by their folders, or as
        the file has it. A camera that is listed for several photographs is one, without their masks.
        InputError: two cameras have one name."""
        for part in (-1, -2, 0):
            named: dict[str, StoredCamera] = {}
            for camera in cameras:
                name = _parts(camera.name)[part:][0] if part else unicodedata.normalize("NFC", camera.name)
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
    *folders, last = unicodedata.normalize("NFC", name).replace("\\", "/").split("/")
    stem, dot, suffix = last.rpartition(".")
    return [*folders, stem if dot and suffix.lower() in _SUFFIXES else last]


def plain(key: str) -> str:
    """A key without case, signs and a final "coefficients" or "parameters", by which files differ."""
    return re.sub(r"(coef|param)\w*$", "", "".join(filter(str.isalnum, key.lower())))


def check_unread(origin: str, fields: Mapping[str, Any], known: Collection[str]) -> None:
    """Warn of entries that are not read. ``fields``: of a camera, or of the file. ``known``: entries that are
    read or do not matter, as :func:`plain` spells them. InputError: an entry about the lens is neither empty
    nor 0: without it the picture would be bent."""
    unread = {key: value for key, value in fields.items() if plain(key) not in known}
    lens = [key for key, value in unread.items() if _LENS.search(plain(key)) and _bends(value)]
    expected = "lens distortion as D or dist: k1 k2 p1 p2 k3 k4 k5 k6, with fisheye k1 k2 k3 k4"
    require(not lens, origin, expected, lens)
    if unread:  # the same text for each camera, which Python shows once
        warnings.warn(f"cameras: entries that are not read: {', '.join(sorted(unread))}", stacklevel=2)


def _bends(value: Any) -> bool:
    """Whether an entry about the lens matters: numbers other than 0, or a model of another kind."""
    if isinstance(value, str):
        return bool(_MODELS.search(plain(value)))
    return bool(np.any(np.asarray(value, object)))


def read_mapping(path: Path, parse: Callable[[str], Any], kind: str, content: str) -> dict[str, Any]:
    """The mapping in a text file. ``kind``, ``content``: for messages. InputError: there is none."""
    value = read_parsed(path, kind, parse)
    require(isinstance(value, dict), str(path), content, type(value).__name__)
    return value


def finite(origin: str, key: str, value: Any) -> float:
    """An entry as a number. InputError: it is not finite, or no number."""
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = math.nan
    require(math.isfinite(number), f"{origin}: {key}", "a finite number", value)
    return number


def pinhole(fx: float, fy: float, cx: float, cy: float) -> np.ndarray:
    """Intrinsics [3, 3] of focal lengths and a principal point in pixels."""
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], np.float64)


def coefficients(numbers: Mapping[str, float], names: str) -> np.ndarray:
    """Distortion coefficients in the order of ``names``, 0 where they are missing; none if all are 0."""
    values = np.array([numbers.get(name, 0.0) for name in names.split()])
    return values if values.any() else np.zeros(0)
