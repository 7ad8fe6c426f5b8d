"""Files of cameras: one module a format, each a function from a path to a :class:`CameraFile`."""

from collections.abc import Callable
from pathlib import Path

from ghgs_capture.formats.camera_file import CameraFile
from ghgs_capture.formats.colmap import model_folder, read_colmap
from ghgs_capture.formats.json_and_toml import read_json, read_json_file, read_toml
from ghgs_capture.formats.nerfstudio import read_nerfstudio
from ghgs_capture.formats.opencv import EASYMOCAP, read_easymocap, read_opencv, yaml_files
from ghgs_capture.formats.qualisys import read_qualisys
from ghgs_lit.errors import InputError, choice, require
from ghgs_lit.parsing import find_path

__all__ = ["FORMATS", "CameraFile", "read_cameras"]

#: Readers by the format's name; ``ghgs`` is this package's JSON.
FORMATS: dict[str, Callable[[Path], CameraFile]] = {
    "ghgs": read_json,
    "colmap": read_colmap,
    "nerfstudio": read_nerfstudio,
    "opencv": read_opencv,
    "easymocap": read_easymocap,
    "toml": read_toml,
    "qualisys": read_qualisys,
}
#: Formats that may have several files, and endings of those of one.
_OF_FOLDERS = ("colmap", "opencv", "easymocap")
_SINGLE = (".json", ".toml", ".qca.txt")


def read_cameras(path: str | Path, format: str = "auto") -> CameraFile:
    """Read a file or a folder of cameras; a warning names entries that are not read.

    Args:
        path: a file, or the folder of one: of transforms.json, COLMAP's model, EasyMocap's files,
            OpenCV's YAML of each camera, or a single JSON, TOML or .qca.txt.
        format: one of :data:`FORMATS`; ``auto`` tells it by file names and keys of JSON.

    Returns:
        The cameras, and the meaning of their numbers by the format.

    Raises:
        InputError: no such path or format, or a wrong camera.
    """
    path = Path(path).expanduser()
    choice("calibration.format", format, ("auto", *FORMATS))
    if not path.exists():
        raise InputError(f"{path}: expected a file or folder of cameras; found no such path")
    path = _file_in(path, format) if path.is_dir() else path
    return FORMATS[_format_of(path) if format == "auto" else format](path)


def _file_in(folder: Path, format: str) -> Path:
    """The file of a folder that holds the cameras; the folder itself for formats of several files.
    InputError: there are several."""
    of_folder = format in _OF_FOLDERS or find_path(folder, EASYMOCAP[0]) is not None
    if of_folder or (format == "auto" and (model_folder(folder) is not None or yaml_files(folder))):
        return folder
    transforms = find_path(folder, "transforms.json")
    if transforms is not None and format in ("auto", "nerfstudio"):
        return transforms
    files = [path for path in sorted(folder.iterdir()) if path.name.lower().endswith(_SINGLE)]
    expected = "one file of cameras, or transforms.json"
    require(len(files) < 2, str(folder), expected, ", ".join(path.name for path in files))
    return files[0] if files else folder


def _format_of(path: Path) -> str:
    """The format of a path, by names of files and keys of JSON.
    InputError: it is none that is known."""
    suffix = path.suffix.lower()
    folder = path if path.is_dir() else path.parent
    if path.name.lower() in EASYMOCAP or (path.is_dir() and find_path(path, EASYMOCAP[0]) is not None):
        return "easymocap"
    if path.is_dir():
        if model_folder(path) is not None:
            return "colmap"
        if yaml_files(path):
            return "opencv"
    elif suffix in (".yml", ".yaml"):
        return "opencv"
    elif suffix == ".toml":
        return "toml"
    elif suffix == ".json":
        return "nerfstudio" if "frames" in read_json_file(path) else "ghgs"
    elif path.name.lower().endswith(".qca.txt"):
        return "qualisys"
    elif suffix in (".bin", ".txt") and model_folder(folder) is not None:
        return "colmap"
    raise InputError(
        f"{path}: expected JSON, transforms.json, a COLMAP model, YAML of OpenCV or EasyMocap,"
        " TOML, or Qualisys' .qca.txt; found"
        f" {'a folder without any' if path.is_dir() else repr(path.suffix)}"
    )
