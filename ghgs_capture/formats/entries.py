"""Cameras of a file, and the entries of each: read under any usual spelling, of the right type,
or named."""

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

#: What files call the same thing, as :func:`plain` spells it.
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
    "gains": ("gains",),
}
#: Coefficients with an entry each: of OpenCV's model, and of a fisheye's.
PERSPECTIVE = "k1 k2 p1 p2 k3 k4 k5 k6"
FISHEYE = "k1 k2 k3 k4"
# Camera models that are read: those of a pinhole, with OpenCV's distortion,
# and of OpenCV's fisheye.
_PINHOLES = ("pinhole", "perspective", "simplepinhole", "none")
_BROWN = (
    *("opencv", "radial", "simpleradial", "fullopencv", "brown", "brownconrady", "radtan", "standard"),
    *("plumbbob", "rationalpolynomial", "radialtangential"),
)
_FISHEYES = (
    *("opencvfisheye", "simpleradialfisheye", "radialfisheye", "fisheye", "equidistant"),
    *("kannalabrandt", "kannalabrandt4", "kb4"),
)
# Entries about a lens, as :func:`plain` spells them, and models that such entries may name.
_KINDS = "fisheye|omni|spheric|equirect|latlong|theta|panoram|orthogr|cylind|catadiop|stereograph"
_LENS = re.compile(f"(?<!un)dist(?!ance)|lens|radial|tangent|model|^k$|^[kps][0-9]$|^xi$|{_KINDS}")
_MODELS = re.compile(f"equidist|kannala|division|prism|fov|ucm|doublesphere|vr180|360|{_KINDS}")
#: Entries of a camera, or beside cameras, that do not matter, as :func:`plain` spells them.
IRRELEVANT = (
    *("name", "names", "id", "camid", "port", "serial", "rotationcount", "error", "exposure", "gridcount"),
    *("ignore", "verifiedresolutions", "rectifyalpha", "metadata", "cameras"),
    *("time", "n", "f", "v", "ccm", "bounds"),
)


def plain(key: str) -> str:
    """A key without case, signs and a final "coefficients" or "parameters", by which files differ.

    Args:
        key: as the file has it.

    Returns:
        Lower-case letters and digits alone.
    """
    return re.sub(r"(coef|param)\w*$", "", "".join(filter(str.isalnum, str(key).lower())))


def _read_number(place: str, value: Any) -> float:
    """An entry as a number; text that spells a number is one."""
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
    """The entries of a camera. A null counts as missing. Methods give None where an entry is
    missing, and refuse (InputError) one of a wrong type, and two that mean the same and differ.

    ``what`` is one of :data:`NAMES`, or another key.

    Attributes:
        origin: file and camera, for messages.
        fields: values by key as the file has them."""

    def __init__(self, origin: str, fields: Mapping[str, Any]) -> None:
        self.origin = origin
        self.fields = {str(key): value for key, value in fields.items() if value is not None}
        self._read: set[str] = set()

    def keys(self, what: str) -> list[str]:
        """The keys of the file that spell ``what``, the preferred first."""
        names = NAMES.get(what, (plain(what),))
        spelled = [key for key in self.fields if plain(key) in names]
        return sorted(spelled, key=lambda key: names.index(plain(key)))

    def number(self, what: str) -> float | None:
        """A finite number."""
        return self._value(what, _read_number)

    def flag(self, what: str) -> bool | None:
        """True or false, also as 1 or 0; anything else, such as the text "no", is refused."""
        return self._value(what, _read_flag)

    def text(self, what: str) -> str | None:
        """Text; None also where it is empty."""
        return self._value(what, _read_text) or None

    def has(self, what: str, *shapes: tuple[int | None, ...]) -> bool:
        """Whether there is an array of one of several shapes; None is any length of an axis."""
        return any(_fits(self.fields[key], shapes) for key in self.keys(what))

    def array(self, what: str, *shapes: tuple[int | None, ...]) -> np.ndarray | None:
        """An array of one of several shapes, as of :meth:`has`.

        Of several entries those count that have such a shape: ``K`` is a matrix beside ``k``,
        coefficients of a lens."""

        def numbers(place: str, value: Any) -> np.ndarray:
            require(not _has_flags(value), place, "numbers", value)
            return check_array(place, value, shapes)

        keys = self.keys(what)
        return self._value(
            what, numbers, [key for key in keys if _fits(self.fields[key], shapes)] or keys[:1]
        )

    def needed(self, what: str, *shapes: tuple[int | None, ...]) -> np.ndarray:
        """As :meth:`array`, of an entry that must be there."""
        value = self.array(what, *shapes)
        names = NAMES.get(what, (what,))
        require(value is not None, self.origin, f"{what} ({' or '.join(names)})", sorted(self.fields))
        return value

    def _value(self, what: str, convert: Callable[[str, Any], Any], keys: Sequence[str] | None = None) -> Any:
        """The one value of all entries that spell ``what``, or of some ``keys`` of these."""
        keys = self.keys(what) if keys is None else keys
        self._read |= set(keys)
        values = [convert(f"{self.origin}: {key}", self.fields[key]) for key in keys]
        same = all(np.array_equal(np.ravel(value), np.ravel(values[0])) for value in values)
        require(same, self.origin, f"one {what}", f"different ones: {' and '.join(keys)}")
        return values[0] if values else None

    @property
    def size(self) -> tuple[int, int] | None:
        """(height, width) in pixels, given as two numbers or as a list (width, height)."""
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
        """Whether flag or model say so; they must not differ."""
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
        """Distortion coefficients, as a list or with an entry each.

        Args:
            order: names of the entries that are allowed, in their order, with spaces between them.

        Returns:
            The coefficients, of a list as it is; those with an entry each in this order, none if
            all are 0.

        Raises:
            InputError: there is another coefficient that is not 0, or list and entries differ.
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
        """Keys of entries that nothing has read so far.

        Args:
            irrelevant: keys that do not matter, spelled as :func:`plain` does.

        Raises:
            InputError: one about the lens is neither empty nor 0: without it the picture would be
                bent.
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
    """Whether an entry says something of the lens: numbers other than 0, or a model of another
    kind, which may be the value of any key, such as ``type``. ``key``: spelled as
    :func:`plain` does."""
    if isinstance(value, str):
        model = plain(value)
        is_model = bool(_MODELS.match(model)) and len(value.split()) == 1
        return is_model or bool(_LENS.search(key) and _MODELS.search(model))
    return bool(_LENS.search(key)) and bool(np.any(np.asarray(value, object)))


def _fits(value: Any, shapes: tuple[tuple[int | None, ...], ...]) -> bool:
    """Whether nested lists are numbers of one of several shapes; None is any length."""
    try:
        check_array("", value, shapes)
    except InputError:
        return False
    return True


def _has_flags(value: Any) -> bool:
    """Whether true or false is among the numbers of nested lists."""
    return any(map(_has_flags, value)) if isinstance(value, list | tuple) else isinstance(value, bool)


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


@dataclass(frozen=True)
class CameraFile:
    """The cameras of a file by name, and the meaning of their numbers by its format."""

    cameras: dict[str, StoredCamera]
    convention: Convention

    @classmethod
    def of(
        cls, cameras: Sequence[StoredCamera], convention: Convention, unread: Sequence[str] = ()
    ) -> "CameraFile":
        """Name cameras by their photographs, without folder and suffix, in their order.

        Where different cameras share such a name (that of an instant), all are named by their
        folders, or as the file has it. A camera that is listed for several photographs is one,
        without their masks. One warning names all entries that are not read.

        Args:
            cameras: with names as the file has them.
            convention: meaning of their numbers by the format.
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
