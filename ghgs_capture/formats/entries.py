"""Entries of a camera in a file: read under any usual spelling, of the right type, or named."""

import math
import re
from collections.abc import Collection, Mapping
from typing import Any

import numpy as np

from ghgs_lit.data.decoding import check_array
from ghgs_lit.errors import require

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
_BROWN = ("opencv", "radial", "simpleradial", "fullopencv", "brown", "brownconrady", "radtan", "standard")
_BROWN += ("plumbbob", "rationalpolynomial", "radialtangential")
_FISHEYES = ("opencvfisheye", "simpleradialfisheye", "radialfisheye", "fisheye", "equidistant")
_FISHEYES += ("kannalabrandt", "kannalabrandt4", "kb4")
# Entries about a lens, as :func:`plain` spells them, and models that such entries may name.
_KINDS = "fisheye|omni|spheric|equirect|latlong|theta|panoram|orthogr|cylind|catadiop|stereograph"
_LENS = re.compile(f"(?<!un)dist(?!ance)|lens|radial|tangent|model|^k$|^[kps][0-9]$|^xi$|{_KINDS}")
_MODELS = re.compile(f"equidist|kannala|division|prism|fov|ucm|doublesphere|vr180|360|{_KINDS}")


def plain(key: str) -> str:
    """A key without case, signs and a final "coefficients" or "parameters", by which files differ.

    Args:
        key: as the file has it.

    Returns:
        Lower-case letters and digits alone.
    """
    return re.sub(r"(coef|param)\w*$", "", "".join(filter(str.isalnum, str(key).lower())))


def finite(place: str, value: Any) -> float:
    """An entry as a number.

    Args:
        place: file and key, for the message.
        value: as the file has it; text that spells a number is one.

    Returns:
        The number.

    Raises:
        InputError: it is not finite, or no number.
    """
    try:
        number = math.nan if isinstance(value, bool) else float(value)
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    require(math.isfinite(number), place, "a finite number", value)
    return number


class Entries:
    """The entries of a camera. A null counts as missing. Methods give None where an entry is
    missing, and refuse (InputError) one of a wrong type, and two that mean the same and differ.

    Attributes:
        origin: file and camera, for messages.
        fields: values by key as the file has them."""

    def __init__(self, origin: str, fields: Mapping[str, Any]) -> None:
        self.origin = origin
        self.fields = {str(key): value for key, value in fields.items() if value is not None}
        self._read: set[str] = set()

    def keys(self, what: str) -> list[str]:
        """Find the keys that spell one thing.

        Args:
            what: one of :data:`NAMES`, or another key.

        Returns:
            Keys as the file has them, the preferred first.
        """
        names = NAMES.get(what, (plain(what),))
        spelled = [key for key in self.fields if plain(key) in names]
        return sorted(spelled, key=lambda key: names.index(plain(key)))

    def number(self, what: str) -> float | None:
        """A finite number.

        Args:
            what: as for :meth:`keys`.

        Returns:
            The number; None: there is no such entry.

        Raises:
            InputError: an entry is no finite number, or two differ.
        """
        return self._one(
            what, {key: finite(f"{self.origin}: {key}", self.fields[key]) for key in self.keys(what)}
        )

    def whole(self, what: str) -> int | None:
        """A whole number above 0.

        Args:
            what: as for :meth:`keys`.

        Returns:
            The number; None: there is no such entry.

        Raises:
            InputError: an entry is no such number, or two differ.
        """
        number = self.number(what)
        if number is None:
            return None
        expected = "a whole number above 0"
        require(number > 0 and number == int(number), f"{self.origin}: {what}", expected, number)
        return int(number)

    def flag(self, what: str) -> bool | None:
        """True or false, also as 1 or 0.

        Args:
            what: as for :meth:`keys`.

        Returns:
            The value; None: there is no such entry.

        Raises:
            InputError: an entry is anything else, such as the text "no", or two differ.
        """
        values = {}
        for key in self.keys(what):
            value = self.fields[key]
            is_flag = isinstance(value, bool | int | float) and value in (0, 1)
            require(is_flag, f"{self.origin}: {key}", "true or false", value)
            values[key] = bool(value)
        return self._one(what, values)

    def text(self, what: str) -> str | None:
        """Text that is not empty.

        Args:
            what: as for :meth:`keys`.

        Returns:
            The text; None: there is no such entry, or it is empty.

        Raises:
            InputError: an entry is no text, or two differ.
        """
        values = {key: self.fields[key] for key in self.keys(what)}
        for key, value in values.items():
            require(isinstance(value, str), f"{self.origin}: {key}", "text", value)
        return self._one(what, values) or None

    def has(self, what: str, *shapes: tuple[int | None, ...]) -> bool:
        """Whether there is an array of one of several shapes.

        Args:
            what: as for :meth:`keys`.
            shapes: lengths of the axes; None is any length.
        """
        return any(_fits(self.fields[key], shapes) for key in self.keys(what))

    def array(self, what: str, *shapes: tuple[int | None, ...]) -> np.ndarray | None:
        """An array of one of several shapes.

        Of several entries those count that have such a shape: ``K`` is a matrix beside ``k``,
        coefficients of a lens.

        Args:
            what: as for :meth:`keys`.
            shapes: lengths of the axes; None is any length.

        Returns:
            The array; None: there is no such entry.

        Raises:
            InputError: an entry has another shape or no finite numbers, or two differ.
        """
        keys = self.keys(what)
        fitting = [key for key in keys if _fits(self.fields[key], shapes)]
        values = {}
        for key in fitting or keys[:1]:
            value = self.fields[key]
            require(not _has_flags(value), f"{self.origin}: {key}", "numbers", value)
            values[key] = check_array(f"{self.origin}: {key}", value, shapes)
        return self._one(what, values)

    def needed(self, what: str, *shapes: tuple[int | None, ...]) -> np.ndarray:
        """As :meth:`array`, of an entry that must be there.

        Args:
            what: as for :meth:`keys`.
            shapes: as for :meth:`array`.

        Returns:
            The array.

        Raises:
            InputError: there is none; or as for :meth:`array`.
        """
        value = self.array(what, *shapes)
        names = NAMES.get(what, (what,))
        require(value is not None, self.origin, f"{what} ({' or '.join(names)})", sorted(self.fields))
        return value

    def _one(self, what: str, values: Mapping[str, Any]) -> Any:
        """The value of all ``values`` by key, which are equal."""
        self._read |= values.keys()
        first = next(iter(values.values()), None)
        same = all(np.array_equal(np.ravel(value), np.ravel(first)) for value in values.values())
        require(same, self.origin, f"one {what}", f"different ones: {' and '.join(values)}")
        return first

    @property
    def size(self) -> tuple[int, int] | None:
        """(height, width) in pixels, given as two numbers or as a list (width, height)."""
        width = self.whole("width")
        height = self.whole("height")
        both = self.array("size", (2,), (2, 1), (1, 2))
        if both is not None:
            listed = tuple(int(side) for side in both.ravel())
            is_whole = bool((both.ravel() == listed).all()) and min(listed) > 0
            require(is_whole, f"{self.origin}: size", "whole numbers above 0", both.ravel().tolist())
            same = width in (None, listed[0]) and height in (None, listed[1])
            require(same, f"{self.origin}: size", f"width and height {width} x {height}", list(listed))
            width, height = listed
        return None if width is None or height is None else (height, width)

    @property
    def is_fisheye(self) -> bool:
        """Whether flag or model say so.

        Raises:
            InputError: they differ, or a model is not read.
        """
        flag = self.flag("fisheye")
        models = {key: str(self.fields[key]) for key in self.keys("model")}
        self._read |= models.keys()
        expected = f"a camera model among {', '.join((*_PINHOLES, *_BROWN, *_FISHEYES))}"
        for key, model in models.items():
            is_known = plain(model) in (*_PINHOLES, *_BROWN, *_FISHEYES)
            require(is_known, f"{self.origin}: {key}", expected, model)
        fisheyes = [plain(model) in _FISHEYES for model in models.values()]
        named = " and ".join(models.values())
        mixed = any(fisheyes) and any(plain(model) in _BROWN for model in models.values())
        require(not mixed, self.origin, "one model of the lens", named)
        differ = flag is not None and models and flag != any(fisheyes)
        require(
            not differ,
            f"{self.origin}: {' and '.join(self.keys('fisheye'))}",
            f"{any(fisheyes)} beside {named}",
            flag,
        )
        return any(fisheyes) if flag is None else flag

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
        values = coefficients(single, order)
        if listed is None:
            return values
        listed = listed.ravel()
        known = dict(zip(order.split(), listed, strict=False))
        same = all(known.get(name, 0.0) == number for name, number in single.items())
        require(same, self.origin, f"one distortion, {listed.tolist()}", f"another: {single}")
        return listed

    def unread(self, irrelevant: Collection[str]) -> tuple[str, ...]:
        """Keys of entries that nothing has read so far.

        Args:
            irrelevant: keys that do not matter, spelled as :func:`plain` does.

        Returns:
            The keys as the file has them.

        Raises:
            InputError: one about the lens is neither empty nor 0: without it the picture would be
                bent.
        """
        left = {
            key: value
            for key, value in self.fields.items()
            if key not in self._read and plain(key) not in irrelevant
        }
        lens = [key for key, value in left.items() if _bends(plain(key), value)]
        expected = (
            "lens distortion as D or dist: k1 k2 p1 p2 k3 k4 k5 k6, with fisheye k1 k2 k3 k4, and"
            " no other camera model"
        )
        require(not lens, self.origin, expected, lens)
        return tuple(left)


def coefficients(numbers: Mapping[str, float], names: str) -> np.ndarray:
    """Distortion coefficients in an order.

    Args:
        numbers: coefficients by name; those that are missing are 0.
        names: their order, with spaces between them.

    Returns:
        [n] float64; none if all are 0.
    """
    values = np.array([numbers.get(name, 0.0) for name in names.split()])
    return values if values.any() else np.zeros(0)


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
    """Whether nested lists have one of several shapes; None is any length."""
    try:
        sizes = np.shape(value)
    except ValueError:  # lists of different lengths
        return False
    for shape in shapes:
        same_rank = len(sizes) == len(shape)
        if same_rank and all(side in (None, n) for side, n in zip(shape, sizes, strict=True)):
            return True
    return False


def _has_flags(value: Any) -> bool:
    """Whether true or false is among the numbers of nested lists."""
    return any(map(_has_flags, value)) if isinstance(value, list | tuple) else isinstance(value, bool)
