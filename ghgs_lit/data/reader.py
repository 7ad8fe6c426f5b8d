"""What every data set gives: photographs with cameras, by subject, position and view.

A data set is a :class:`Reader`. It says where its files lie and what is in them; sampling, resizing,
padding, caching and batching are the same for all and ask a reader only.
"""

import re
from abc import ABC, abstractmethod
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from ghgs_lit.errors import InputError, require

DEPTH_SCALE = 1 << 15
# How far from the image's centre a principal point may lie, as a part of the side.
_OFF_CENTRE = 0.25
_SAFE_NAME = re.compile(r"[\w.+-]+")


@dataclass(frozen=True)
class View:
    """One photograph: ``image`` [h, w, 3] uint8, ``mask`` [h, w] bool, ``inverse_depth`` [h, w] uint16
    (2^15 / metres, 0 where unknown) or None, ``intrinsics`` [3, 3] for pixel centres at +0.5 and
    ``extrinsics`` [4, 4] world to camera in metres, both float32."""

    image: np.ndarray
    mask: np.ndarray
    inverse_depth: np.ndarray | None
    intrinsics: np.ndarray
    extrinsics: np.ndarray

    @property
    def depth(self) -> np.ndarray | None:
        """Metres [h, w] float32, 0 where unknown."""
        if self.inverse_depth is None:
            return None
        known = self.inverse_depth > 0
        return np.where(known, DEPTH_SCALE / np.where(known, self.inverse_depth, 1), 0).astype(np.float32)

    @property
    def nbytes(self) -> int:
        return self.image.nbytes + self.mask.nbytes + getattr(self.inverse_depth, "nbytes", 0) + 1024


class Reader(ABC):
    """Photographs of one phase (``train`` or ``val``) of a data set, read at ``size``.

    ``subjects`` maps each subject that can be drawn (a person, or one frame of a person: a name that
    can stand in a file name) to the positions of its cameras. A photograph is ``(position, vid)``;
    only rings that were rendered with views between their cameras have another ``vid`` than 0.

    Args:
        size: (height, width) of the views; None: as stored.
        cache_mb: decoded views kept in every process, least recently used dropped first.
        strict: whether the first problem of the data set raises; else :attr:`problems` collects them.
    """

    def __init__(self, size: tuple[int, int] | None = None, cache_mb: float = 0, strict: bool = True) -> None:
        require(cache_mb >= 0, "data.cache_images_mb", "at least 0", cache_mb)
        self.size, self.strict = size, strict
        self.subjects: dict[str, tuple[int, ...]] = {}
        self.problems: list[str] = []
        self._cache: OrderedDict[tuple, View | np.ndarray | None] = OrderedDict()
        self._cached, self._limit = 0, int(cache_mb * 2**20)

    @abstractmethod
    def read_view(self, name: str, pid: int, vid: int, depth: bool) -> View:
        """The view as it is stored; its depth map only where ``depth`` asks for one.

        Raises:
            InputError: a file is missing or bad; it says which and how.
        """

    @abstractmethod
    def read_body(self, name: str) -> np.ndarray | None:
        """Vertices [n, 3] float32 of the body in the world, or None where the data has none."""

    def vids(self, name: str, pid: int) -> list[int]:
        """Views that have a photograph at a position."""
        return [0]

    def problem(self, line: str) -> None:
        """Something that keeps a part of the data set from being used: raised, or collected."""
        if self.strict:
            raise InputError(line)
        self.problems.append(line)

    def view(self, name: str, pid: int, vid: int = 0, depth: bool = True) -> View:
        """A view, resized, its intrinsics too.

        Raises:
            InputError: a file is missing or bad, or nobody is in the mask.
        """

        def read() -> View:
            view = self.read_view(name, pid, vid, depth)
            if not view.mask.any():
                raise InputError(f"{self.place(name, pid, vid)}: expected a subject in the mask; found none")
            return view if self.size is None else fit(view, *self.size)

        return self._remember((name, pid, vid, depth), read)

    def body(self, name: str) -> np.ndarray | None:
        """As :meth:`read_body`, remembered."""
        return self._remember((name,), lambda: self.read_body(name))

    def place(self, name: str, pid: int, vid: int) -> str:
        """What messages call a view: best the path of its mask."""
        return f"{name}, camera {pid}, view {vid}"

    def _remember(self, key: tuple, read: Callable[[], Any]) -> Any:
        if key in self._cache:
            self._cache.move_to_end(key)
            return self._cache[key]
        value = read()
        nbytes = getattr(value, "nbytes", 0)
        if nbytes <= self._limit:
            self._cache[key] = value
            self._cached += nbytes
            while self._cached > self._limit:
                self._cached -= getattr(self._cache.popitem(last=False)[1], "nbytes", 0)
        return value


def check_name(name: str) -> str:
    """``name``, which results and pictures will carry in their file names."""
    require(bool(_SAFE_NAME.fullmatch(name)), "subject", "letters, digits and . + - _ only", name)
    return name


def fit(view: View, height: int, width: int) -> View:
    """The view resized: image by area, mask and depth by the nearest value, intrinsics with them."""
    h, w = view.mask.shape
    if (h, w) == (height, width):
        return view
    scale = np.array([[width / w], [height / h]], np.float64)
    intrinsics = view.intrinsics.astype(np.float64)
    intrinsics[:2] *= scale
    depth = view.inverse_depth
    return replace(
        view,
        image=resize_image(view.image, height, width),
        mask=resize_nearest(view.mask, height, width),
        inverse_depth=None if depth is None else resize_nearest(depth, height, width),
        intrinsics=intrinsics.astype(np.float32),
    )


def resize_image(image: np.ndarray, height: int, width: int) -> np.ndarray:
    """[height, width, 3] uint8: the mean over the area of each pixel, bicubic where it grows."""
    h, w = image.shape[:2]
    if (h, w) == (height, width):
        return image
    if h % height == w % width == 0:  # a quarter of the time of the general case
        return np.asarray(Image.fromarray(image).reduce((w // width, h // height)))
    method = Image.Resampling.BOX if width <= w and height <= h else Image.Resampling.BICUBIC
    return np.asarray(Image.fromarray(image).resize((width, height), method))


def resize_nearest(array: np.ndarray, height: int, width: int) -> np.ndarray:
    """The value at the centre of each new pixel: mask and depth stay of one surface, and agree."""
    rows = ((np.arange(height) + 0.5) * array.shape[0] / height).astype(int)
    columns = ((np.arange(width) + 0.5) * array.shape[1] / width).astype(int)
    return np.ascontiguousarray(array[rows[:, None], columns])


def read_image(path: Path) -> Image.Image:
    """A decoded image.

    Raises:
        InputError: it is missing, or cannot be decoded.
    """
    if not path.exists():
        raise InputError(f"{path}: expected an image; found no such file")
    try:
        image = Image.open(path)
        image.load()
    except (OSError, SyntaxError, Image.DecompressionBombError) as error:
        raise InputError(f"{path}: expected a readable image; found {error}") from error
    return image


def rgb(image: Image.Image) -> np.ndarray:
    """[h, w, 3] uint8 of an image of any mode."""
    return np.asarray(image if image.mode == "RGB" else image.convert("RGB"))


def read_map(path: Path, size: tuple[int, int]) -> np.ndarray:
    """Channel 0 of a mask or depth map that must have the ``size`` (height, width) of its photograph.

    Raises:
        InputError: it is missing, cannot be decoded, or has another size.
    """
    array = np.asarray(read_image(path))
    if array.shape[:2] != size:
        raise InputError(
            f"{path}: expected the size of its photograph, {size[0]}x{size[1]}; "
            f"found {array.shape[0]}x{array.shape[1]}"
        )
    return array if array.ndim == 2 else array[..., 0]


def check_array(path: Path | str, array: Any, shapes: Sequence[tuple[int | None, ...]]) -> np.ndarray:
    """``array`` as finite float64 of one of ``shapes`` (None: any length).

    Raises:
        InputError: naming ``path``, where it is no such array.
    """
    wanted = " or ".join("x".join("n" if s is None else str(s) for s in shape) for shape in shapes)
    try:
        array = np.asarray(array).astype(np.float64)
    except (ValueError, TypeError) as error:
        raise InputError(f"{path}: expected an array {wanted}; found {error}") from error
    fits = any(
        array.ndim == len(shape) and all(s in (None, a) for s, a in zip(shape, array.shape, strict=True))
        for shape in shapes
    )
    if not fits:
        raise InputError(f"{path}: expected an array {wanted}; found {'x'.join(map(str, array.shape))}")
    if not np.isfinite(array).all():
        raise InputError(f"{path}: expected finite numbers; found NaN or infinity")
    return array


def read_array(path: Path, shapes: Sequence[tuple[int | None, ...]]) -> np.ndarray:
    """A finite float64 array of one of ``shapes`` (None: any length) from an ``.npy`` file.

    Raises:
        InputError: it is missing, unreadable, of another shape or not finite.
    """
    wanted = " or ".join("x".join("n" if s is None else str(s) for s in shape) for shape in shapes)
    if not path.exists():
        raise InputError(f"{path}: expected an array {wanted}; found no such file")
    try:
        array = np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError, TypeError) as error:
        raise InputError(
            f"{path}: expected an array {wanted}; found a file that cannot be read: {error}"
        ) from error
    return check_array(path, array, shapes)


def check_intrinsics(path: Path | str, intrinsics: Any) -> np.ndarray:
    """Finite [3, 3] with focal lengths above 0.

    Raises:
        InputError: naming ``path``.
    """
    intrinsics = check_array(path, intrinsics, [(3, 3)])
    if min(intrinsics[0, 0], intrinsics[1, 1]) <= 0:
        raise InputError(
            f"{path}: expected focal lengths above 0; found {intrinsics[0, 0]}, {intrinsics[1, 1]}"
        )
    return intrinsics


def check_centre(path: Path, intrinsics: np.ndarray, height: int, width: int) -> None:
    """A photograph that was resized by somebody no longer fits its calibration.

    Raises:
        InputError: naming the photograph, where the principal point lies far from its centre.
    """
    if np.abs(intrinsics[:2, 2] / [width, height] - 0.5).max() > _OFF_CENTRE:
        raise InputError(
            f"{path}: expected a photograph of the calibration's size, its principal point "
            f"{intrinsics[0, 2]:.0f}, {intrinsics[1, 2]:.0f} near the centre; found {height}x{width}"
        )


def opencv_view(image: np.ndarray, mask: np.ndarray, intrinsics: np.ndarray, extrinsics: np.ndarray) -> View:
    """A photograph of an OpenCV calibration, which puts pixel centres at integers, without its background."""
    intrinsics = np.array(intrinsics)
    intrinsics[:2, 2] += 0.5
    image = np.where(mask[..., None], image, 0)
    return View(image, mask, None, intrinsics.astype(np.float32), extrinsics.astype(np.float32))


def check_extrinsics(path: Path | str, extrinsics: Any) -> np.ndarray:
    """Finite [4, 4] of [3, 4] or [4, 4], world to camera, with a rotation in it.

    Raises:
        InputError: naming ``path``.
    """
    extrinsics = np.concatenate((check_array(path, extrinsics, [(3, 4), (4, 4)])[:3], [[0, 0, 0, 1]]))
    rotation = extrinsics[:3, :3]
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-2 or np.linalg.det(rotation) < 0:
        found = np.round(rotation, 3).tolist()
        raise InputError(f"{path}: expected a rotation in the first three columns; found {found}")
    return extrinsics
