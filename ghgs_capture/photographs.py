"""Find and decode photographs in folders, and match them with cameras by name."""

import functools
import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ghgs_capture.calibration import StoredCamera, same_ratio
from ghgs_lit.data.decoding import orientation_of, read_image, rgb_of
from ghgs_lit.errors import InputError, require
from ghgs_lit.parsing import find_path, normalize_name

SUFFIXES = (".jpg", ".jpeg", ".jpe", ".jfif", ".png", ".webp", ".avif", ".tif", ".tiff", ".bmp")
#: Suffixes of unsupported image formats, and of files that are never photographs
PICTURES = "heic heif hif jxl jp2 j2k gif tga ppm pgm exr hdr psd dng cr2 cr3 nef arw raf orf rw2 pef srw raw"
_COMPANIONS = "json xml xmp txt toml yaml yml csv npy npz pkl aae md log ply obj"
MASK_ENDING = "_mask"  #: Ending of the name of a mask next to its photograph
# Also with a number, or "fmask" for foreground
_MASK = re.compile(r"_f?mask_?\d*$", re.IGNORECASE)
#: Words in names that describe the kind of image, not its content
_KINDS = (
    "rgb rgbs img image images color colour photo frame mask masks fmask matte alpha silhouette seg label"
)
#: Quarter turns, as for ``numpy.rot90``, by EXIF orientation
_TURNS = {1: 0, 3: 2, 6: 3, 8: 1}


@dataclass(frozen=True)
class Pixels:
    """A decoded photograph as shown, with its EXIF rotation applied."""

    image: np.ndarray  #: [h, w, 3] uint8, RGB
    alpha: np.ndarray | None  #: [h, w] uint8; None if the file has no alpha
    turns: int  #: applied quarter turns, as for ``numpy.rot90``

    @property
    def size(self) -> tuple[int, int]:
        """(height, width) as shown."""
        return self.image.shape[:2]

    @property
    def stored_size(self) -> tuple[int, int]:
        """(height, width) as stored in the file."""
        return self.size[::-1] if self.turns % 2 else self.size


def read_pixels(path: Path) -> Pixels:
    """Decode a photograph with 8 bits per channel and apply its EXIF rotation.

    Raises:
        InputError: the file is missing, cannot be decoded, has other values, or is mirrored.
    """
    image = read_image(path)
    orientation = orientation_of(image, path)
    orientation_found = f"EXIF orientation {orientation}"
    require(orientation in _TURNS, str(path), "a photograph that is not mirrored", orientation_found)
    turns = _TURNS[orientation]
    alpha = None
    colors = np.rot90(rgb_of(image, path), turns)
    if image.has_transparency_data:
        alpha = np.rot90(np.asarray(image.convert("RGBA").getchannel("A")), turns)
    return Pixels(colors, alpha, turns)


def fits_stored(pixels: Pixels, camera: StoredCamera, exif: str) -> bool:
    """Whether a camera was calibrated with the photograph as stored, not as shown.

    With ``auto``, it depends on the size of the calibration for quarter turns; otherwise the answer is no,
    since OpenCV applies the EXIF rotation when it reads photographs.

    Args:
        pixels: the decoded photograph.
        camera: the camera as stored in its file.
        exif: ``auto`` | ``stored`` | ``shown``, the user's choice.
    """
    if exif != "auto" or not pixels.turns:
        return exif == "stored"
    size = camera.size
    return size is not None and same_ratio(size, pixels.stored_size) and not same_ratio(size, pixels.size)


def compose_names(names: Mapping[Any, Any] | None) -> dict[str, str]:
    """Convert ``calibration.names`` (cameras by photograph) to text in Unicode's composed form.

    Args:
        names: keys and values are text or numbers; None: empty.
    """
    return {normalize_name(str(key)): normalize_name(str(name)) for key, name in (names or {}).items()}


def list_images(folder: Path, suffixes: tuple[str, ...] = SUFFIXES) -> dict[str, Path]:
    """List the photographs of a folder, without masks.

    Args:
        folder: the folder.
        suffixes: suffixes of photographs, in lower case with the dot.

    Returns:
        Paths by name without suffix, sorted.

    Raises:
        InputError: two photographs have the same name, or a folder has the name of a photograph.
    """
    paths: dict[str, Path] = {}
    for path in sorted(folder.iterdir()):
        is_image = path.suffix.lower() in suffixes and not path.name.startswith(".")
        if not is_image or _MASK.search(path.stem):
            continue
        require(not path.is_dir(), str(path), "a photograph", "a folder")
        name = normalize_name(path.stem)
        require(name not in paths, str(path), "one file for each photograph", str(paths.get(name)))
        paths[name] = path
    return paths


def parts_of_name(name: str) -> tuple[str, ...]:
    """Split a name without suffix into words and numbers, without the words for the kind of image:
    ``cam1_rgb007`` becomes cam, 1, 007."""
    parts = re.findall(r"\d+|[^\W\d_]+", normalize_name(name).casefold())
    return tuple(part for part in parts if part not in _KINDS.split())


def find_similar_mask(folder: Path, name: str, is_beside: bool) -> Path | None:
    """Find the only mask in a folder whose name has the same parts (:func:`parts_of_name`).

    Args:
        folder: the folder; may be missing.
        name: name of a photograph, without suffix.
        is_beside: whether the folder also contains photographs.
    """
    if not folder.is_dir():
        return None
    paths = _by_parts(folder, folder.stat().st_mtime_ns).get(parts_of_name(name), [])
    paths = [path for path in paths if _MASK.search(path.stem) or not is_beside]
    return paths[0] if len(paths) == 1 else None


@functools.lru_cache(maxsize=64)
def _by_parts(folder: Path, changed: int) -> dict[tuple[str, ...], list[Path]]:
    """Images of a folder by the parts of their names, cached by its modification time ``changed``."""
    paths: dict[tuple[str, ...], list[Path]] = {}
    for path in sorted(folder.iterdir()):
        if path.suffix.lower() in SUFFIXES and not path.name.startswith("."):
            paths.setdefault(parts_of_name(path.stem), []).append(path)
    return paths


def find_image(folder: Path, *names: str, suffixes: tuple[str, ...] = SUFFIXES) -> Path | None:
    """Find an image in a folder by name.

    Args:
        folder: the folder.
        names: names without suffix, the preferred first.
        suffixes: suffixes of images, in lower case with the dot.

    Returns:
        The path, or None.
    """
    return next((path for name in names if (path := find_path(folder, name, suffixes))), None)


def require_all_read(
    folder: Path, read: Collection[str], known: Collection[str], suffixes: tuple[str, ...] = SUFFIXES
) -> None:
    """Check that no photograph or video is silently left out.

    Args:
        folder: folder of photographs or videos.
        read: names of the files that are read; other files with these names are ignored.
        known: further names, of cameras or instants.
        suffixes: supported suffixes, for the message.

    Raises:
        InputError: there is an image of an unsupported format, or another file with a known name, such as
            ``right.heic`` or ``right.jpg.part``.
    """
    for path in sorted(folder.iterdir()):
        name = normalize_name(path.name)
        kind = path.suffix.lower().removeprefix(".")
        begins = {name[:end] for end, letter in enumerate(f"{name}.") if letter == "."}
        is_other = path.name.startswith(".") or path.is_dir() or _MASK.search(path.stem)
        if is_other or kind in _COMPANIONS.split() or not begins.isdisjoint(read):
            continue
        if kind in PICTURES.split() or not begins.isdisjoint(known):
            raise InputError(
                f"{path}: expected a file that can be read ({', '.join(suffixes)}); found another"
                " kind (convert it, or move it elsewhere to do without it)"
            )


def find_instants(
    folder: Path, cameras: Mapping[str, StoredCamera], names: Mapping[str, str]
) -> dict[str, dict[str, Path]]:
    """Find photographs in a folder or in its subfolders.

    A subfolder contains one instant with a photograph of every camera, or, if named after a camera, one
    photograph per instant. Names may start with the camera's (``front_rgb0001``). In a sequence, instants
    may lack photographs.

    Args:
        folder: folder of photographs, or of such folders.
        cameras: cameras by name.
        names: cameras of photographs (or of cameras' folders) with other names.

    Returns:
        ``{instant: {camera: path}}``.

    Raises:
        InputError: there are no photographs, or they do not match the cameras.
    """
    problem = "a file" if folder.exists() else "no such folder"
    require(folder.is_dir(), str(folder), "a folder of photographs", problem)
    known = {*cameras, *names}
    photographs = list_images(folder)
    require_all_read(folder, photographs, known)
    if photographs:
        if of_cameras := _split_names(photographs, cameras, names):
            instants = _by_instant(folder, of_cameras)
            return {name or folder.resolve().name: paths for name, paths in instants.items()}
        return {folder.resolve().name: by_camera(folder, photographs, cameras, names)}
    places = {
        normalize_name(path.name): path
        for path in sorted(folder.iterdir(), key=lambda path: natural_key(path.name))
        if path.is_dir() and not path.name.startswith(".")
    }
    below = {name: list_images(path) for name, path in places.items()}
    for name, paths in below.items():
        is_camera = find_camera(name, cameras, names) in cameras
        instants = set().union(*below.values())
        require_all_read(places[name], paths, instants if is_camera else known)
    folders = {name: paths for name, paths in below.items() if paths}
    require(bool(folders), str(folder), f"photographs ({', '.join(SUFFIXES)})", "none")
    if all(find_camera(name, cameras, names) in cameras for name in folders):
        return _by_instant(folder, by_camera(folder, folders, cameras, names))
    least = 2 if len(folders) == 1 else 1
    return {name: by_camera(folder / name, paths, cameras, names, least) for name, paths in folders.items()}


def _split_names(
    photographs: Mapping[str, Path], cameras: Mapping[str, StoredCamera], names: Mapping[str, str]
) -> dict[str, dict[str, Path]]:
    """Photographs by camera and by the rest of their names; empty unless all names start with a camera's
    and none is equal to one."""
    of_cameras: dict[str, dict[str, Path]] = {}
    for name, path in photographs.items():
        parts = parts_of_name(name)
        begins = {parts_of_name(known): known for known in (*cameras, *names)}
        count = max((n for n in range(1, len(parts) + 1) if parts[:n] in begins), default=0)
        rest = "_".join(parts[count:])
        camera = names.get(begins.get(parts[:count], ""), begins.get(parts[:count], ""))
        if not count or find_camera(name, cameras, names) in cameras or rest in of_cameras.get(camera, {}):
            return {}
        of_cameras.setdefault(camera, {})[rest] = path
    return of_cameras


def natural_key(name: str) -> list[str | int]:
    """Sort key of names that orders numbers by value: 2 before 10."""
    return [int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", name)]


def _by_instant(folder: Path, by_camera: Mapping[str, dict[str, Path]]) -> dict[str, dict[str, Path]]:
    """Turn ``{camera: {instant: path}}`` into ``{instant: {camera: path}}``."""
    first, *others = by_camera
    if any(by_camera[first].keys().isdisjoint(by_camera[other]) for other in others):
        by_camera = {camera: _without_folder(paths) for camera, paths in by_camera.items()}
    for other in others:
        shared = by_camera[first].keys() & by_camera[other].keys()
        expected = f"photographs named as those of {first}"
        examples = ", ".join(list(by_camera[other])[:3])
        require(bool(shared), f"{folder}: {other}", expected, f"others: {examples}")
    instants = sorted(set().union(*by_camera.values()), key=natural_key)
    by_instant = {}
    for instant in instants:
        of_cameras = {camera: paths[instant] for camera, paths in by_camera.items() if instant in paths}
        by_instant[instant] = of_cameras
    return by_instant


def _without_folder(paths: Mapping[str, Path]) -> Mapping[str, Path]:
    """Photographs of a camera by their names without the folder's name, or unchanged if names would
    coincide."""
    named = {}
    for name, path in paths.items():
        parts, folder = parts_of_name(name), parts_of_name(path.parent.name)
        parts = parts[len(folder) :] if parts[: len(folder)] == folder else parts
        named["_".join(parts)] = path
    return named if len(named) == len(paths) and "" not in named else paths


def find_camera(name: str, cameras: Collection[str], names: Mapping[str, str]) -> str:
    """Find the camera of a photograph by its name.

    Args:
        name: name of the photograph, without suffix.
        cameras: names of all cameras.
        names: cameras of photographs with other names.

    Returns:
        The camera of ``names``, or the one of this name, or the only one whose name differs only by
        case; without any, the name itself.
    """
    wanted = names.get(name, name)
    alike = [camera for camera in cameras if camera.casefold() == wanted.casefold()]
    return alike[0] if wanted not in cameras and len(alike) == 1 else wanted


def by_camera(
    folder: Path,
    values: Mapping[str, Any],
    cameras: Mapping[str, StoredCamera],
    names: Mapping[str, str],
    least: int = 2,
) -> dict[str, Any]:
    """Map values from names of photographs, videos or folders to cameras.

    Args:
        folder: folder of the values, for messages.
        values: values by name.
        cameras: cameras by name.
        names: cameras of photographs with other names.
        least: minimum number of values.

    Raises:
        InputError: a name matches no camera, two names match the same camera, or there are fewer than
            ``least`` values.
    """
    named = {name: find_camera(name, cameras, names) for name in values}
    unknown = [name for name, camera in named.items() if camera not in cameras]
    if unknown:
        raise InputError(
            f"{folder}: expected photographs named after cameras ({', '.join(cameras)}), or"
            f" calibration.names={{photograph: camera}}; found {', '.join(unknown)}"
        )
    require(len(values) >= least, str(folder), f"{least} photographs or more", len(values))
    assigned = {named[name]: value for name, value in values.items()}
    require(len(assigned) == len(values), "calibration.names", "one photograph for each camera", dict(names))
    return assigned
