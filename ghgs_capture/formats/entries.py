"""Cameras of a file, and their entries, which are read under any usual spelling and checked for type."""

import math
import re
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ghgs_capture.calibration import Convention, StoredCamera
from ghgs_capture.photographs import PICTURES, SUFFIXES
from ghgs_lit.data.decoding import check_array
from ghgs_lit.errors import InputError, require
from ghgs_lit.parsing import normalize_name, split_path

#: Synonyms of each entry in files, as normalised by :func:`plain`
NAMES = {
    "intrinsics": ("k", "cameramatrix", "matrix", "intrinsicmatrix", "intrinsic", "intrinsics", "m"),
    "extrinsics": ("extrinsics",),
    "distortion": ("d", "dist", "distortion", "dists", "distortions", "lensdistortion", "kc"),
    "rotation": ("rot", "rotationmatrix", "r", "rvec", "rotation", "rotationvector"),
    "translation": ("t", "tvec", "translation", "translationvector"),
    "size": ("size", "imagesize", "imgsize", "resolution"),
    "width": ("width", "imagewidth", "w"),
    "height": ("height", "imageheight", "h"),
    "fisheye": ("fisheye", "isfisheye", "usefisheye", "fisheyemodel"),
    "model": ("cameramodel", "distortionmodel", "lensmodel", "projection", "projectionmodel"),
}
#: Names of distortion coefficients: of OpenCV's perspective and fisheye models
PERSPECTIVE = "k1 k2 p1 p2 k3 k4 k5 k6"
FISHEYE = "k1 k2 k3 k4"
# Supported camera models: pinhole, with OpenCV's distortion, and OpenCV's fisheye
_PINHOLES = ("pinhole", "perspective", "simplepinhole", "none")
_BROWN = (
    *("opencv", "radial", "simpleradial", "fullopencv", "brown", "brownconrady", "radtan", "standard"),
    *("plumbbob", "rationalpolynomial", "radialtangential"),
)
_FISHEYES = (
    *("opencvfisheye", "simpleradialfisheye", "radialfisheye", "fisheye", "equidistant"),
    *("kannalabrandt", "kannalabrandt4", "kb4"),
)
# Patterns of keys that concern a lens, as normalised by :func:`plain`, and of names of lens models
_KINDS = "fisheye|omni|spheric|equirect|latlong|theta|panoram|orthogr|cylind|catadiop|stereograph"
_LENS = re.compile(f"(?<!un)dist(?!ance)|lens|radial|tangent|model|^k$|^[kps][0-9]$|^xi$|{_KINDS}")
_MODELS = re.compile(f"equidist|kannala|division|prism|fov|ucm|doublesphere|vr180|360|{_KINDS}")
#: Irrelevant entries of a camera or of its file, as normalised by :func:`plain`
IRRELEVANT = (
    *("name", "names", "id", "camid", "port", "serial", "rotationcount", "error", "exposure", "gridcount"),
    *("ignore", "verifiedresolutions", "rectifyalpha", "metadata", "cameras"),
    *("time", "n", "f", "v", "ccm", "bounds"),
)


def plain(key: str) -> str:
    """Normalise a key of a file to lower-case letters and digits, without a final "coefficients" or
    "parameters"."""
    return re.sub(r"(coef|param)\w*$", "", "".join(filter(str.isalnum, str(key).lower())))


def _read_number(place: str, value: Any) -> float:
    """Convert an entry to a number, also from text."""
    try:
        number = math.nan if isinstance(value, bool) else float(value)
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    require(math.isfinite(number), place, "a finite number", value)
    return number


def _read_flag(place: str, value: Any) -> bool:
    is_flag = isinstance(value, bool | int | float) and value in (0, 1)
    require(is_flag, place, "true or false", value)
    return bool(value)


def _read_text(place: str, value: Any) -> str:
    require(isinstance(value, str), place, "text", value)
    return value


class Entries:
    """The entries of a camera; null counts as missing.

    Methods return None for a missing entry, and raise InputError for an entry of a wrong type and for
    synonymous entries with different values. ``what`` is a key of :data:`NAMES`, or another key.

    Attributes:
        origin: file and camera, for messages.
        fields: values by key, as in the file."""

    def __init__(self, origin: str, fields: Mapping[str, Any]) -> None:
        self.origin = origin
        self.fields = {str(key): value for key, value in fields.items() if value is not None}
        self._read: set[str] = set()

    def keys(self, what: str) -> list[str]:
        """Keys of the file that are synonyms of ``what``, the preferred first."""
        names = NAMES.get(what, (plain(what),))
        spelled = [key for key in self.fields if plain(key) in names]
        return sorted(spelled, key=lambda key: names.index(plain(key)))

    def number(self, what: str) -> float | None:
        """Read a finite number."""
        return self._value(what, _read_number)

    def flag(self, what: str) -> bool | None:
        """Read true or false, also as 1 or 0; anything else, such as the text "no", raises InputError."""
        return self._value(what, _read_flag)

    def text(self, what: str) -> str | None:
        """Read text; None also if it is empty."""
        return self._value(what, _read_text) or None

    def has(self, what: str, *shapes: tuple[int | None, ...]) -> bool:
        """Whether there is an array of one of several shapes; None in a shape allows any length."""
        return any(_fits(self.fields[key], shapes) for key in self.keys(what))

    def array(self, what: str, *shapes: tuple[int | None, ...]) -> np.ndarray | None:
        """Read an array of one of several shapes, as for :meth:`has`.

        Among synonymous entries only those with such a shape are read: a file may contain a matrix ``K``
        and lens coefficients ``k``."""

        def numbers(place: str, value: Any) -> np.ndarray:
            require(not _has_flags(value), place, "numbers", value)
            return check_array(place, value, shapes)

        keys = self.keys(what)
        return self._value(
            what, numbers, [key for key in keys if _fits(self.fields[key], shapes)] or keys[:1]
        )

    def needed(self, what: str, *shapes: tuple[int | None, ...]) -> np.ndarray:
        """Read an array as :meth:`array`; raises InputError if it is missing."""
        value = self.array(what, *shapes)
        names = NAMES.get(what, (what,))
        require(value is not None, self.origin, f"{what} ({' or '.join(names)})", sorted(self.fields))
        return value

    def _value(self, what: str, convert: Callable[[str, Any], Any], keys: Sequence[str] | None = None) -> Any:
        """Common value of all synonyms of ``what``, or only of ``keys``, which count as read."""
        keys = self.keys(what) if keys is None else keys
        self._read |= set(keys)
        values = [convert(f"{self.origin}: {key}", self.fields[key]) for key in keys]
        same = all(np.array_equal(np.ravel(value), np.ravel(values[0])) for value in values)
        require(same, self.origin, f"one {what}", f"different ones: {' and '.join(keys)}")
        return values[0] if values else None

    @property
    def size(self) -> tuple[int, int] | None:
        """(height, width) in pixels, from two numbers or a list (width, height) in the file."""
        both = self.array("size", (2,), (2, 1), (1, 2))
        sides = []
        for name, listed in zip(
            ("width", "height"), (None, None) if both is None else both.ravel(), strict=True
        ):
            single = self.number(name)
            side = single if listed is None else listed
            is_whole = side is None or (side > 0 and side == int(side))
            require(is_whole, f"{self.origin}: {name}", "a whole number above 0", side)
            require(single in (None, side), f"{self.origin}: size", f"a {name} of {single}", side)
            sides.append(side)
        return None if None in sides else (int(sides[1]), int(sides[0]))

    @property
    def is_fisheye(self) -> bool:
        """Whether the lens is a fisheye, from a flag or the camera model, which must agree."""
        flag = self.flag("fisheye")
        models = {key: str(self.fields[key]) for key in self.keys("model")}
        self._read |= models.keys()
        known = (*_PINHOLES, *_BROWN, *_FISHEYES)
        for key, model in models.items():
            expected = f"a camera model among {', '.join(known)}"
            require(plain(model) in known, f"{self.origin}: {key}", expected, model)
        kinds = {plain(model) for model in models.values()}
        is_fisheye = not kinds.isdisjoint(_FISHEYES)
        named = " and ".join(models.values())
        require(not is_fisheye or kinds.isdisjoint(_BROWN), self.origin, "one model of the lens", named)
        place = f"{self.origin}: {' and '.join(self.keys('fisheye'))}"
        agree = flag is None or not models or flag == is_fisheye
        require(agree, place, f"{is_fisheye} beside {named}", flag)
        return is_fisheye if flag is None else flag

    def distortion(self, order: str) -> np.ndarray:
        """Read distortion coefficients from a list or from one entry each.

        Args:
            order: names of the allowed entries in their order, separated by spaces.

        Returns:
            The list as in the file, or the entries in this order; empty if all entries are 0.

        Raises:
            InputError: another coefficient is not 0, or list and entries differ.
        """
        listed = self.array("distortion", (None,), (None, 1), (1, None))
        numbers = {name: self.number(name) for name in PERSPECTIVE.split()}
        single = {name: number for name, number in numbers.items() if number is not None}
        beyond = [name for name, number in single.items() if number and name not in order.split()]
        require(not beyond, self.origin, f"distortion {order}", beyond)
        if listed is None:
            values = np.array([single.get(name, 0.0) for name in order.split()])
            return values if values.any() else np.zeros(0)
        listed = listed.ravel()
        known = dict(zip(order.split(), listed, strict=False))
        same = all(known.get(name, 0.0) == number for name, number in single.items())
        require(same, self.origin, f"one distortion, {listed.tolist()}", f"another: {single}")
        return listed

    def unread(self, irrelevant: Sequence[str] = IRRELEVANT) -> tuple[str, ...]:
        """Keys of entries that have not been read.

        Args:
            irrelevant: keys to leave out, as normalised by :func:`plain`.

        Raises:
            InputError: an unread entry concerns the lens and is neither empty nor 0; ignoring it would
                leave the image distorted.
        """
        left = [key for key in self.fields if key not in self._read and plain(key) not in irrelevant]
        lens = [key for key in left if _bends(plain(key), self.fields[key])]
        expected = (
            "lens distortion as D or dist: k1 k2 p1 p2 k3 k4 k5 k6, with fisheye k1 k2 k3 k4, and"
            " no other camera model"
        )
        require(not lens, self.origin, expected, lens)
        return tuple(left)


def _bends(key: str, value: Any) -> bool:
    """Whether an entry (key normalised by :func:`plain`) describes a lens: numbers other than 0, or an
    unsupported model, which may be the value of any key, such as ``type``."""
    if isinstance(value, str):
        model = plain(value)
        is_model = bool(_MODELS.match(model)) and len(value.split()) == 1
        return is_model or bool(_LENS.search(key) and _MODELS.search(model))
    return bool(_LENS.search(key)) and bool(np.any(np.asarray(value, object)))


def _fits(value: Any, shapes: tuple[tuple[int | None, ...], ...]) -> bool:
    """Whether nested lists are numbers of one of several shapes."""
    try:
        check_array("", value, shapes)
    except InputError:
        return False
    return True


def _has_flags(value: Any) -> bool:
    """Whether nested lists contain true or false."""
    return any(map(_has_flags, value)) if isinstance(value, list | tuple) else isinstance(value, bool)


def pinhole(fx: float, fy: float, cx: float, cy: float) -> np.ndarray:
    """Intrinsics [3, 3] float64 of a pinhole camera, from focal lengths and principal point in pixels."""
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], np.float64)


@dataclass(frozen=True)
class CameraFile:
    """The cameras of a file by name, and its format's convention for their numbers."""

    cameras: dict[str, StoredCamera]
    convention: Convention

    @classmethod
    def of(
        cls, cameras: Sequence[StoredCamera], convention: Convention, unread: Sequence[str] = ()
    ) -> "CameraFile":
        """Name cameras after their photographs, without folder and suffix, in their order.

        If different cameras would share a name (that of an instant), all are named after their folders,
        or else as in the file. A camera that is listed for several photographs is kept once, without
        their masks. One warning lists all entries that are not read.

        Args:
            cameras: with names as in the file.
            convention: the format's convention for their numbers.
            unread: unread keys of the file outside of the cameras.

        Raises:
            InputError: two different cameras have the same name.
        """
        if unread := sorted(set(unread).union(*(camera.unread for camera in cameras))):
            warnings.warn(f"cameras: entries that are not read: {', '.join(unread)}", stacklevel=3)
        for part in (-1, -2, 0):
            named: dict[str, StoredCamera] = {}
            for camera in cameras:
                name = _split_name(camera.name)[part:][0] if part else normalize_name(camera.name)
                if name not in named:
                    named[name] = camera
                elif named[name].has_numbers_of(camera):
                    named[name] = replace(camera, mask=None)
                else:
                    break
            else:
                return cls(named, convention)
        raise InputError(f"{camera.origin}: expected cameras of different names; found {name} twice")


def _split_name(name: str) -> list[str]:
    *folders, last = split_path(name)
    path = Path(last)
    suffix = path.suffix.lower()
    is_picture = suffix in SUFFIXES or suffix[1:] in PICTURES.split()
    return [*folders, path.stem if is_picture else last]
