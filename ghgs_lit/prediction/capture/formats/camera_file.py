"""Cameras of a file, and what the readers of all formats share."""

import re
import unicodedata
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ghgs_lit.errors import InputError, require
from ghgs_lit.prediction.capture.calibration import Convention, StoredCamera

_SUFFIXES = ("jpg", "jpeg", "png", "tif", "tiff", "bmp", "webp")
# Entries of a lens, as :func:`plain` spells them: leaving one out would bend the picture.
_LENS = re.compile(
    r"(?<!un)dist(?!ance)|lens|radial|tangent|fisheye|omni|ftheta|latlong|equirect|^[kps]\d$|^xi$"
)
# Models of lenses, by a part of their names: Kannala and Brandt's, OpenCV's, and those that are not read.
_FISHEYE = re.compile("fisheye|equidistant|kannala")
_PERSPECTIVE = re.compile("opencv|pinhole|radial|perspective|plumbbob|radtan|rational|brown")
_OTHER = re.compile("omni|spher|equirect|theta|division|panoram|latlong|orthogr|unified|prism|fov")


@dataclass(frozen=True)
class CameraFile:
    """The cameras of a file.

    Attributes:
        cameras: by name.
        convention: the meaning of their numbers by the format.
        format: its name.
        unread: entries of the file that say nothing to its reader.
    """

    cameras: dict[str, StoredCamera]
    convention: Convention
    format: str
    unread: tuple[str, ...] = ()

    @classmethod
    def of(
        cls,
        cameras: Sequence[StoredCamera],
        convention: Convention,
        format: str,
        unread: Collection[str] = (),
    ) -> "CameraFile":
        """Cameras in their order, named by their photographs without folder and suffix.

        Where photographs of one camera have different names, those of several instants, the camera is named
        by their folder.

        Raises:
            InputError: two cameras have one name.
        """
        unread = sorted({*unread, *(key for camera in cameras for key in camera.unread)})
        for part in (-1, -2):
            named = _merged(cameras, [_parts(camera.name)[part:][0] for camera in cameras])
            if named is not None:
                return cls(named, convention, format, tuple(unread))
        whole = {unicodedata.normalize("NFC", camera.name): camera for camera in cameras}
        names = [camera.name for camera in cameras]
        twice = sorted({name for name in names if names.count(name) > 1})
        require(len(whole) == len(names), cameras[0].origin, "cameras of different names", f"twice {twice}")
        return cls(whole, convention, format, tuple(unread))


def _parts(name: str) -> list[str]:
    """Folders and name of a photograph, without its suffix."""
    *folders, last = unicodedata.normalize("NFC", name).replace("\\", "/").split("/")
    stem, dot, suffix = last.rpartition(".")
    return [*folders, stem if dot and suffix.lower() in _SUFFIXES else last]


def end_of(photograph: str) -> str:
    """Folder and name of a photograph without its suffix, by which :meth:`StoredCamera.mask_of` finds it."""
    return "/".join(_parts(photograph)[-2:])


def _merged(cameras: Sequence[StoredCamera], names: Sequence[str]) -> dict[str, StoredCamera] | None:
    """Cameras by name with the masks of all their photographs; None where one name has two cameras."""
    merged: dict[str, StoredCamera] = {}
    for name, camera in zip(names, cameras, strict=True):
        first = merged.get(name)
        if first is None:
            merged[name] = camera
        elif camera.name == first.name or not camera.is_same(first):
            return None
        else:
            merged[name] = replace(first, masks={**first.masks, **camera.masks})
    return merged


def plain(key: str) -> str:
    """A key without case, underscores and other signs, by which files differ."""
    return "".join(filter(str.isalnum, str(key).lower()))


def unread(origin: str, fields: Mapping[str, Any], known: Collection[str]) -> tuple[str, ...]:
    """The keys that a reader does not know.

    Args:
        origin: file and key, for messages.
        fields: of a camera.
        known: what is read or says nothing about the picture, as :func:`plain` spells it.

    Raises:
        InputError: one of them is about the lens, and not empty or 0.
    """
    keys = [key for key in fields if plain(key) not in known]
    lens = [key for key in keys if _LENS.search(plain(key)) and _bends(fields[key])]
    expected = "lens distortion as D or dist: k1 k2 p1 p2 k3 k4 k5 k6, with fisheye k1 k2 k3 k4"
    require(not lens, origin, expected, lens)
    return tuple(keys)


def _bends(value: Any) -> bool:
    """Whether an entry about the lens says something: numbers other than 0, or a model of another kind."""
    if isinstance(value, str):
        return bool(_FISHEYE.search(plain(value)) or _OTHER.search(plain(value)))
    return bool(np.any(np.asarray(value, object)))


def is_fisheye(origin: str, flag: Any, model: Any) -> bool:
    """Whether distortion is that of Kannala and Brandt's model, by a flag, or the model's name, or both.

    Raises:
        InputError: the flag is none, they contradict each other, or it is a model of another kind.
    """
    kind = plain(model or "")
    expected = "a camera model of OpenCV (perspective or fisheye)"
    named = True if _FISHEYE.search(kind) else False if _PERSPECTIVE.search(kind) else None
    require(bool(named) or not _OTHER.search(kind), f"{origin}: camera model", expected, model)
    if flag is None:
        return bool(named)
    require(flag in (0, 1), f"{origin}: fisheye", "true or false", flag)
    require(named in (None, bool(flag)), f"{origin}: fisheye", f"the lens of {model}", flag)
    return bool(flag)


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
        # Editors of Windows mark UTF-8.
        value = parse(path.read_text(encoding="utf-8-sig"))
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
