"""Convert calibrations from the conventions of files to those of :mod:`ghgs_lit.types`.

Few files state whether poses map the world to the camera, and with which axes. The format or the user
defines it.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from ghgs_lit.data.decoding import check_extrinsics, check_intrinsics
from ghgs_lit.data.view import half_centers
from ghgs_lit.errors import InputError, require

EXTRINSICS = ("world_to_camera", "camera_to_world")
AXES = ("opencv", "opengl")
INTRINSICS = ("pixels", "normalized", "normalized_principal")

#: Converts between the camera axes of OpenGL (y up, z backward) and OpenCV (y down, z forward).
_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
# Video is coded in blocks of 16 pixels, so some programs crop a sensor's 1088 rows to 1080.
_CODED = 1088
_SHOWN = 1080
# Distance from the origin beyond which a rotation's seventh digit moves a centre by
# more than 0.1 mm.
_FAR = 1e3
# Pixels by which a side may differ from the calibration's ratio of sides: rounding of a resize.
_ROUNDING = 1.5


@dataclass(frozen=True)
class Convention:
    """Meaning of the numbers of a calibration.

    Attributes:
        extrinsics: what the poses map: ``world_to_camera`` | ``camera_to_world``.
        axes: axes of the camera: ``opencv`` (y down, z forward) | ``opengl`` (y up, z backward).
        intrinsics: ``pixels``, or shares of width and height: ``normalized`` (all) |
            ``normalized_principal`` (the principal point alone).
        pixel_centers: the first pixel's centre lies at 0.5 (``half``) or at 0
            (``integer``, as OpenCV's).
        resized: factor of a resize after the calibration, in addition to sizes stored in the file.
        unit: metres of one unit of length.
        exif: whether the calibration is for the pixels as stored or with the EXIF rotation applied:
            ``auto`` | ``stored`` | ``shown``."""

    extrinsics: str = "world_to_camera"
    axes: str = "opencv"
    intrinsics: str = "pixels"
    pixel_centers: str = "half"
    resized: float = 1.0
    unit: float = 1.0
    exif: str = "auto"

    def __post_init__(self) -> None:
        for name, value in (("resized", self.resized), ("unit", self.unit)):
            expected = "a number above 0, from 1e-9 to 1e9"
            require(1e-9 <= value <= 1e9, f"calibration.{name}", expected, value)

    def with_options(self, options: Mapping[str, Any]) -> "Convention":
        """Override attributes of the convention with the user's values.

        Args:
            options: values by attribute name; None and other keys are ignored.

        Raises:
            InputError: ``resized`` or ``unit`` is out of range.
        """
        named = {f.name: options.get(f.name) for f in fields(self)}
        return replace(self, **{name: value for name, value in named.items() if value is not None})


@dataclass(frozen=True)
class PartialIntrinsics:
    """Intrinsics that depend on the photograph's size, for x and y; None for values that the file lacks."""

    focal: tuple[float | None, float | None]  #: in pixels
    #: principal point in pixels; None: the photograph's centre
    middle: tuple[float | None, float | None]
    angles: tuple[float | None, float | None]  #: angles of view in radians, used if there is no focal length

    @property
    def is_known(self) -> bool:
        """Whether the intrinsics do not depend on the photograph's size."""
        return self.focal != (None, None) and None not in self.middle

    def intrinsics(self, size: tuple[int, int]) -> np.ndarray:
        """Complete the intrinsics for one photograph.

        Pixels are square if the file has a single focal length.

        Args:
            size: (height, width) of the photograph in pixels.

        Returns:
            The matrix [3, 3] float64 in pixels.
        """
        sides = size[::-1]
        focal = [
            side / 2 / math.tan(angle / 2) if pixels is None and angle is not None else pixels
            for pixels, angle, side in zip(self.focal, self.angles, sides, strict=True)
        ]
        fx, fy = (value if value is not None else next(filter(None, focal)) for value in focal)
        cx, cy = (side / 2 if m is None else m for m, side in zip(self.middle, sides, strict=True))
        return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])


@dataclass(frozen=True)
class StoredCamera:
    """One camera as a file stores it.

    Attributes:
        origin: file and key, for messages.
        intrinsics: [3, 3] float64.
        pose: [4, 4] float64, a rotation and a translation.
        size: (height, width) in pixels of the calibrated images; None if the file lacks it.
        distortion: 0 to 14 numbers: OpenCV's k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4 tx ty; with
            ``fisheye`` k1 to k4 of Kannala and Brandt's model.
        mask: path of the photograph's mask; None if the file lacks it.
        lens: replaces ``intrinsics`` if they depend on the photograph's size and the file has no
            size.
        unread: keys of the camera in the file that are not read."""

    name: str
    origin: str
    intrinsics: np.ndarray
    pose: np.ndarray
    size: tuple[int, int] | None = None
    distortion: np.ndarray = field(default_factory=lambda: np.zeros(0))
    fisheye: bool = False
    mask: Path | None = None
    lens: PartialIntrinsics | None = None
    unread: tuple[str, ...] = ()

    def has_numbers_of(self, other: "StoredCamera") -> bool:
        """Whether both cameras of a file have the same intrinsics, pose, distortion and size."""
        both = ((c.intrinsics, c.pose, c.distortion, c.size or (), c.fisheye) for c in (self, other))
        return self.lens == other.lens and all(map(np.array_equal, *both))

    def with_size(self, photograph: tuple[int, int]) -> "StoredCamera":
        """Set the camera's size and the intrinsics that depend on it.

        Args:
            photograph: (height, width) in pixels, for a camera whose file has no size.

        Returns:
            The camera with a size; unchanged if the file has one.
        """
        if self.size is not None:
            return self
        intrinsics = self.intrinsics if self.lens is None else self.lens.intrinsics(photograph)
        return replace(self, size=photograph, intrinsics=intrinsics, lens=None)

    def __post_init__(self) -> None:
        lens = check_intrinsics(f"{self.origin}: intrinsics", self.intrinsics)
        object.__setattr__(self, "intrinsics", lens)
        object.__setattr__(self, "pose", check_extrinsics(f"{self.origin}: rotation", self.pose))
        counts = (0, 4) if self.fisheye else (0, 4, 5, 8, 12, 14)
        expected = f"{', '.join(map(str, counts))} distortion coefficients"
        require(len(self.distortion) in counts, self.origin, expected, len(self.distortion))
        require(bool(np.isfinite(self.distortion).all()), self.origin, "finite distortion", "NaN or infinity")
        positive = self.size is None or min(self.size) > 0
        require(positive, self.origin, "a width and a height above 0", self.size)


@dataclass(frozen=True)
class Calibration:
    """One camera for photographs of one size, in the conventions of :mod:`ghgs_lit.types`."""

    intrinsics: np.ndarray  #: [3, 3] float64 in pixels, pixel centres at +0.5
    extrinsics: np.ndarray  #: [4, 4] float64, world to camera, OpenCV axes
    distortion: np.ndarray  #: this and the following attributes: as for :class:`StoredCamera`
    fisheye: bool


def calibrate(camera: StoredCamera, convention: Convention, photograph: tuple[int, int]) -> Calibration:
    """Convert a camera to this package's conventions, for photographs of one size.

    Intrinsics for another size of the same aspect ratio are scaled.

    Args:
        camera: the camera as stored in its file.
        convention: meaning of its numbers.
        photograph: (height, width) of the photograph in pixels.

    Returns:
        The camera, with its distortion, for photographs of this size.

    Raises:
        InputError: the photograph's aspect ratio differs from the calibration's.
    """
    camera = camera.with_size(photograph)
    size = camera.size
    if not same_ratio(size, photograph):
        shown = tuple(_SHOWN if side == _CODED else side for side in size)
        size = shown if same_ratio(shown, photograph) else size
    intrinsics = camera.intrinsics.copy()
    height, width = size
    if convention.intrinsics != "pixels":
        columns = slice(None) if convention.intrinsics == "normalized" else slice(2, None)
        intrinsics[:2, columns] *= np.array([[width], [height]])
    if convention.pixel_centers == "integer":
        intrinsics = half_centers(intrinsics)
    if size != photograph:
        if not same_ratio(size, photograph):
            raise InputError(
                f"{camera.origin}: expected a photograph of {height}x{width} (height x width) or "
                f"scaled from it, as it was calibrated; found {photograph[0]}x{photograph[1]}"
            )
        intrinsics[:2] *= np.array([[photograph[1] / width], [photograph[0] / height]])
    intrinsics[:2] *= convention.resized
    pose = extrinsics_of(camera.pose, convention)
    return Calibration(intrinsics, pose, camera.distortion, camera.fisheye)


def extrinsics_of(pose: np.ndarray, convention: Convention) -> np.ndarray:
    """Convert a stored pose.

    Beyond a distance of ``_FAR`` from the origin, the rotation is replaced by the nearest orthogonal one,
    which keeps the camera's centre.

    Args:
        pose: [4, 4], as stored in the file.
        convention: the direction of the pose, the camera's axes, and the unit of length.

    Returns:
        World to camera [4, 4] with OpenCV axes, in the convention's unit.
    """
    if convention.extrinsics == "camera_to_world":
        pose = np.linalg.inv(pose)
    extrinsics = _FLIP @ pose if convention.axes == "opengl" else pose.copy()
    extrinsics[:3, 3] *= convention.unit
    return _rigid(extrinsics) if np.abs(extrinsics[:3, 3]).max() > _FAR else extrinsics


def _rigid(pose: np.ndarray) -> np.ndarray:
    """Replace a rotation of seven digits by the nearest orthogonal one, without which the transpose moves
    a camera centre 100 km from the origin by a centimetre."""
    u, _, v = np.linalg.svd(pose[:3, :3])
    rigid = pose.copy()
    rigid[:3, :3] = u @ v
    rigid[:3, 3] = u @ v @ np.linalg.solve(pose[:3, :3], pose[:3, 3])
    return rigid


def same_ratio(one: tuple[int, int], other: tuple[int, int]) -> bool:
    """Whether two sizes have the same aspect ratio, up to rounding to whole pixels (``_ROUNDING``).

    Args:
        one: (height, width) in pixels.
        other: (height, width) in pixels.
    """
    return abs(one[0] * other[1] / one[1] - other[0]) <= _ROUNDING


def quarter_turn(calibration: Calibration, turns: int, size: tuple[int, int]) -> Calibration:
    """Rotate a camera together with its photograph by quarter turns.

    Args:
        calibration: the camera before the rotation, without distortion.
        turns: quarter turns of the photograph counterclockwise, as for ``numpy.rot90``; any integer.
        size: (height, width) of the photograph before the rotation, in pixels.

    Returns:
        The camera of the rotated photograph.
    """
    for _ in range(turns % 4):
        k = calibration.intrinsics
        height, width = size  # new x is the old y, new y is the width less the old x
        turned = np.array([[k[1, 1], 0, k[1, 2]], [0, k[0, 0], width - k[0, 2]], [0, 0, 1.0]])
        rotation = np.array([[0.0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
        calibration = replace(calibration, intrinsics=turned, extrinsics=rotation @ calibration.extrinsics)
        size = (width, height)
    return calibration
