"""The layout on disk of rendered THuman2.0 data: writing it, and reading ours and other people's.

``<root>/<phase>/`` with phase ``train`` or ``val`` holds, for ring position ``pid`` and view ``vid``::

    img/<id>_<pid:03d>/<vid>.jpg             photograph on black (.png is read too)
    mask/<id>_<pid:03d>/<vid>.png            subject where channel 0 is above half of its maximum
    depth/<id>_<pid:03d>/<vid>.png           optional; uint16, 2^15 / z, 0 where there is none
    parm/<id>_<pid:03d>/<vid>_intrinsic.npy  3 x 3 in pixels of the stored image
    parm/<id>_<pid:03d>/<vid>_extrinsic.npy  3 x 4 or 4 x 4, world to camera, metres, OpenCV axes
    smpl/<id>/vertices.npy                   optional (or smplx/): vertices of the body [n, 3]
"""

import re
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from ghgs_lit.data.progress import Progress
from ghgs_lit.errors import InputError, choice, require

DEPTH_SCALE = 1 << 15
_IMAGE_SUFFIXES = (".jpg", ".png", ".jpeg")
_POSITION = re.compile(r"(.+)_(\d{3,})")


@dataclass(frozen=True)
class View:
    """One photograph: ``image`` [h, w, 3] uint8, ``mask`` [h, w] bool, ``inverse_depth`` [h, w] uint16
    or None, ``intrinsics`` [3, 3] for pixel centres at +0.5 and ``extrinsics`` [4, 4], float32."""

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


def encode_depth(depth: np.ndarray) -> np.ndarray:
    """Metres to uint16 inverse depth; 0 stays 0. At 2 m a step is 0.12 mm; nearer than 0.5 m saturates."""
    known = depth > 0
    inverse = np.round(DEPTH_SCALE / np.where(known, depth, 1))
    return np.where(known, np.clip(inverse, 1, 65535), 0).astype(np.uint16)


def write_view(phase: Path, position: str, vid: int, view: View, quality: int = 98) -> None:
    """Write one view below the folder ``phase``; the JPEG keeps full colour resolution."""
    folders = {kind: phase / kind / position for kind in ("img", "mask", "depth", "parm")}
    for folder in folders.values():
        folder.mkdir(parents=True, exist_ok=True)
    Image.fromarray(view.image).save(folders["img"] / f"{vid}.jpg", quality=quality, subsampling=0)
    Image.fromarray(view.mask.astype(np.uint8) * 255).save(folders["mask"] / f"{vid}.png")
    if view.inverse_depth is not None:
        Image.fromarray(view.inverse_depth).save(folders["depth"] / f"{vid}.png")
    np.save(folders["parm"] / f"{vid}_intrinsic.npy", view.intrinsics.astype(np.float64))
    np.save(folders["parm"] / f"{vid}_extrinsic.npy", view.extrinsics[:3].astype(np.float64))


def write_body(phase: Path, name: str, vertices: np.ndarray) -> None:
    folder = phase / "smpl" / name
    folder.mkdir(parents=True, exist_ok=True)
    np.save(folder / "vertices.npy", vertices.astype(np.float32))


def position_name(name: str, pid: int) -> str:
    return f"{name}_{pid:03d}"


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


def read_array(path: Path, shapes: Sequence[tuple[int | None, ...]]) -> np.ndarray:
    """A finite float64 array of one of ``shapes`` (None: any length) from an ``.npy`` file.

    Raises:
        InputError: it is missing, unreadable, of another shape or not finite.
    """
    wanted = " or ".join("x".join("n" if s is None else str(s) for s in shape) for shape in shapes)
    if not path.exists():
        raise InputError(f"{path}: expected an array {wanted}; found no such file")
    try:
        array = np.load(path, allow_pickle=False).astype(np.float64)
    except (OSError, ValueError, EOFError, TypeError) as error:
        raise InputError(
            f"{path}: expected an array {wanted}; found a file that cannot be read: {error}"
        ) from error
    fits = any(
        array.ndim == len(shape) and all(s in (None, a) for s, a in zip(shape, array.shape, strict=True))
        for shape in shapes
    )
    if not fits:
        raise InputError(f"{path}: expected an array {wanted}; found {'x'.join(map(str, array.shape))}")
    if not np.isfinite(array).all():
        raise InputError(f"{path}: expected finite numbers; found NaN or infinity")
    return array


def read_camera(folder: Path, vid: int) -> tuple[np.ndarray, np.ndarray]:
    """Intrinsics [3, 3] and extrinsics [4, 4] in float64.

    Raises:
        InputError: a file is bad, a focal length is not above 0, the rotation is none.
    """
    path = folder / f"{vid}_intrinsic.npy"
    intrinsics = read_array(path, [(3, 3)])
    if min(intrinsics[0, 0], intrinsics[1, 1]) <= 0:
        raise InputError(
            f"{path}: expected focal lengths above 0; found {intrinsics[0, 0]}, {intrinsics[1, 1]}"
        )
    path = folder / f"{vid}_extrinsic.npy"
    extrinsics = np.concatenate((read_array(path, [(3, 4), (4, 4)])[:3], [[0, 0, 0, 1]]))
    rotation = extrinsics[:3, :3]
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-2 or np.linalg.det(rotation) < 0:
        raise InputError(f"{path}: expected a rotation in the first three columns; found {rotation.tolist()}")
    return intrinsics, extrinsics


def resize_image(image: Image.Image, height: int, width: int) -> np.ndarray:
    """[height, width, 3] uint8: the mean over the area of each pixel, bicubic where it grows."""
    image = image.convert("RGB")
    if image.size != (width, height):
        shrinks = width <= image.width and height <= image.height
        image = image.resize((width, height), Image.Resampling.BOX if shrinks else Image.Resampling.BICUBIC)
    return np.asarray(image)


def resize_nearest(array: np.ndarray, height: int, width: int) -> np.ndarray:
    """The value at the centre of each new pixel: mask and depth stay of one surface, and agree."""
    rows = ((np.arange(height) + 0.5) * array.shape[0] / height).astype(int)
    columns = ((np.arange(width) + 0.5) * array.shape[1] / width).astype(int)
    return np.ascontiguousarray(array[rows[:, None], columns])


class Layout:
    """Subjects of one phase of a rendered data set, read at ``size``.

    ``subjects`` maps names (of ``names``, or all that there are; the first ``limit`` of them) to the ring
    positions that exist. ``pixel_centers`` says where the
    renderer that made the files put pixel centres: ``half`` (+0.5, ours) or ``integer`` (the
    published THuman2.0 scripts). Decoded views are kept, least recently used dropped first, up to
    ``cache_mb`` in every process.

    Raises:
        InputError: the root or phase is missing, empty, not wholly rendered, or lacks one of ``names``.
    """

    def __init__(
        self,
        root: str | Path,
        phase: str,
        size: tuple[int, int] | None = None,
        names: Sequence[str] | None = None,
        limit: int | None = None,
        pixel_centers: str = "half",
        body_models: Sequence[str] = ("smpl", "smplx"),
        cache_mb: float = 0,
    ) -> None:
        choice("data.pixel_centers", pixel_centers, ("half", "integer"))
        require(cache_mb >= 0, "data.cache_images_mb", "at least 0", cache_mb)
        self.root = Path(root).expanduser()
        self.folder = self.root / phase
        self.size, self.body_models = size, tuple(body_models)
        self._shift = 0.5 if pixel_centers == "integer" else 0.0
        self._cache: OrderedDict[tuple, View | np.ndarray | None] = OrderedDict()
        self._cached, self._limit = 0, int(cache_mb * 2**20)
        self.subjects = self._find(phase, names, limit)

    def _find(self, phase: str, names: Sequence[str] | None, limit: int | None) -> dict[str, tuple[int, ...]]:
        if not self.root.is_dir():
            raise InputError(f"{self.root}: expected the root of a rendered data set; found no such folder")
        images = self.folder / "img"
        if not images.is_dir():
            raise InputError(
                f"{images}: expected a folder <id>_<position> for every camera; found no such folder"
            )
        found: dict[str, list[int]] = {}
        for entry in images.iterdir():
            if match := _POSITION.fullmatch(entry.name):
                found.setdefault(match[1], []).append(int(match[2]))
        progress = Progress(self.root)
        wanted = sorted({*found, *progress.planned(phase)}) if names is None else list(names)
        wanted = wanted[:limit]
        unfinished = {*progress.missing(phase, wanted), *(name for name in wanted if name not in found)}
        missing = [name for name in wanted if name in unfinished]
        if missing:
            raise InputError(
                f"{images}: expected {len(wanted)} whole subjects; found {len(wanted) - len(missing)} "
                f"({missing[0]} is missing or half-rendered: render again to finish)"
            )
        if not wanted:
            raise InputError(f"{images}: expected folders <id>_<position>; found none")
        return {name: tuple(sorted(found[name])) for name in wanted}

    def view(self, name: str, pid: int, vid: int) -> View:
        """View ``vid`` of position ``pid``, resized, its intrinsics too.

        Raises:
            InputError: a file is missing or bad; it says which and how.
        """
        return self._remember((name, pid, vid), lambda: self._read(position_name(name, pid), vid))

    def vids(self, name: str, pid: int) -> list[int]:
        """Views that have a photograph at a position."""
        files = (self.folder / "img" / position_name(name, pid)).iterdir()
        return sorted(int(p.stem) for p in files if p.suffix in _IMAGE_SUFFIXES and p.stem.isdecimal())

    def body(self, name: str) -> np.ndarray | None:
        """Vertices [n, 3] float32 of the body, or None where the data has none."""
        return self._remember((name,), lambda: self._read_body(name))

    def _remember(self, key: tuple, read):
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

    def _read_body(self, name: str) -> np.ndarray | None:
        for model in self.body_models:
            path = self.folder / model / name / "vertices.npy"
            if path.exists():
                return read_array(path, [(None, 3)]).astype(np.float32)
        return None

    def _read(self, position: str, vid: int) -> View:
        folder = self.folder / "img" / position
        path = next(
            (p for s in _IMAGE_SUFFIXES if (p := folder / f"{vid}{s}").exists()), folder / f"{vid}.jpg"
        )
        image = read_image(path)
        height, width = self.size or (image.height, image.width)
        mask = self._read_map(self.folder / "mask" / position / f"{vid}.png", image)
        mask = resize_nearest(mask, height, width)
        path = self.folder / "depth" / position / f"{vid}.png"
        depth = None
        if path.exists():
            depth = self._read_map(path, image)
            if depth.dtype == np.uint8:
                raise InputError(f"{path}: expected 16 bits of inverse depth; found 8")
            depth = resize_nearest(depth.astype(np.uint16), height, width)
        intrinsics, extrinsics = read_camera(self.folder / "parm" / position, vid)
        intrinsics[:2, 2] += self._shift
        intrinsics[:2] *= np.array([[width / image.width], [height / image.height]])
        # Half of the maximum reads 0/1, 0/255 and compressed masks alike.
        return View(
            image=resize_image(image, height, width),
            mask=mask > mask.max() / 2,
            inverse_depth=depth,
            intrinsics=intrinsics.astype(np.float32),
            extrinsics=extrinsics.astype(np.float32),
        )

    def _read_map(self, path: Path, image: Image.Image) -> np.ndarray:
        """Channel 0 of a mask or depth map that must fit ``image``."""
        array = np.asarray(read_image(path))
        if array.shape[:2] != (image.height, image.width):
            raise InputError(
                f"{path}: expected the size of its photograph, {image.height}x{image.width}; "
                f"found {array.shape[0]}x{array.shape[1]}"
            )
        return array if array.ndim == 2 else array[..., 0]
