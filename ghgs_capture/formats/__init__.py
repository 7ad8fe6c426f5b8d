"""Read files of cameras; each format is a function from a path to a :class:`CameraFile`."""

from collections.abc import Callable, Iterator
from pathlib import Path

from ghgs_capture.formats.colmap import find_model, read_colmap
from ghgs_capture.formats.entries import CameraFile
from ghgs_capture.formats.matrices import EASYMOCAP, list_yaml, read_mapping, read_matrices
from ghgs_capture.formats.nerfstudio import read_nerfstudio
from ghgs_lit.errors import InputError, require, require_choice
from ghgs_lit.parsing import find_path

__all__ = ["FORMATS", "CameraFile", "read_cameras"]

#: Readers by format; ``ghgs`` is this package's JSON.
FORMATS: dict[str, Callable[[Path], CameraFile]] = {
    "ghgs": read_matrices,
    "colmap": read_colmap,
    "nerfstudio": read_nerfstudio,
    "opencv": read_matrices,
    "easymocap": read_matrices,
    "toml": read_matrices,
}
_SINGLE = (".json", ".toml")  # Suffixes of formats with a single file


def read_cameras(path: str | Path, format: str = "auto") -> CameraFile:
    """Read a file or a folder of cameras; a warning lists entries that are not read.

    Args:
        path: a file, or a folder that contains transforms.json, a COLMAP model, EasyMocap's files,
            OpenCV's YAML files, one per camera, or a single JSON or TOML.
        format: one of :data:`FORMATS`; ``auto``: detected from file names and keys of JSON.

    Returns:
        The cameras, and the format's convention for their numbers.

    Raises:
        InputError: the path or format does not exist, or a camera is invalid.
    """
    path = Path(path).expanduser()
    require_choice("calibration.format", format, ("auto", *FORMATS))
    if not path.exists():
        raise InputError(f"{path}: expected a file or folder of cameras; found no such path")
    if format != "auto" and path.is_file():
        return FORMATS[format](path)
    for name, file in _candidates(path):
        if format == "auto" or FORMATS[name] is FORMATS[format]:
            return FORMATS[name](file)
    raise InputError(
        f"{path}: expected JSON, transforms.json, a COLMAP model, YAML of OpenCV or EasyMocap,"
        " or TOML; found"
        f" {'a folder without any' if path.is_dir() else repr(path.suffix)}"
    )


def _candidates(path: Path) -> Iterator[tuple[str, Path]]:
    """Possible formats of a path, each with its file or folder, the preferred first; raises InputError if
    a folder contains several files of cameras."""
    name = path.name.lower()
    if path.is_dir():
        if find_path(path, EASYMOCAP[0]) is not None:
            yield "easymocap", path
        if find_model(path) is not None:
            yield "colmap", path
        if list_yaml(path):
            yield "opencv", path
        if (transforms := find_path(path, "transforms.json")) is not None:
            yield "nerfstudio", transforms
        files = [file for file in sorted(path.iterdir()) if file.name.lower().endswith(_SINGLE)]
        expected = "one file of cameras, or transforms.json"
        require(len(files) < 2, str(path), expected, ", ".join(file.name for file in files))
        for file in files:
            yield from _candidates(file)
    elif name.endswith(".json"):
        yield "nerfstudio" if "frames" in read_mapping(path) else "ghgs", path
    elif name.endswith((".yml", ".yaml", ".toml")):
        yield "opencv", path
    elif name.endswith((".bin", ".txt")) and find_model(path.parent) is not None:
        yield "colmap", path
