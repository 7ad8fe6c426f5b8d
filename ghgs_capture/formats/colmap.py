"""Read COLMAP's sparse models, text and binary, with pycolmap (the extra ``colmap``)."""

from pathlib import Path

from ghgs_capture.calibration import Convention, StoredCamera
from ghgs_capture.formats.entries import CameraFile, Entries, pinhole
from ghgs_capture.formats.matrices import read_camera
from ghgs_lit.errors import InputError, import_optional, require
from ghgs_lit.parsing import require_file

#: Parameters of each of COLMAP's camera models, in order; ``f`` is both focal lengths.
_MODELS = {
    "SIMPLE_PINHOLE": "f cx cy",
    "PINHOLE": "fx fy cx cy",
    "SIMPLE_RADIAL": "f cx cy k1",
    "RADIAL": "f cx cy k1 k2",
    "OPENCV": "fx fy cx cy k1 k2 p1 p2",
    "FULL_OPENCV": "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6",
    "SIMPLE_RADIAL_FISHEYE": "f cx cy k1",
    "RADIAL_FISHEYE": "f cx cy k1 k2",
    "OPENCV_FISHEYE": "fx fy cx cy k1 k2 k3 k4",
}
_FILES = ("cameras", "images", "points3D", "rigs", "frames")


def find_model(path: Path) -> Path | None:
    """Find a sparse model.

    Args:
        path: the model's folder, or a folder above it in COLMAP's layout.

    Returns:
        The folder of the model, or None.
    """
    folders = [path, path / "sparse" / "0", path / "sparse", path / "0"]
    return next((p for p in folders if (p / "cameras.bin").exists() or (p / "cameras.txt").exists()), None)


def read_colmap(path: Path) -> CameraFile:
    """Read the cameras of a sparse model's registered photographs, from text or binary files.

    File formats: https://colmap.github.io/format.html; camera models:
    https://colmap.github.io/cameras.html.

    Args:
        path: folder of the model or above it, or one of its files.

    Returns:
        Cameras named after their photographs.

    Raises:
        InputError: the model cannot be read, pycolmap is not installed, or a camera model is not
            supported.
    """
    folder = find_model(path if path.is_dir() else path.parent)
    require(folder is not None, str(path), "a COLMAP model (cameras.bin or cameras.txt)", "none")
    pycolmap = import_optional("pycolmap", "colmap", str(path))
    for file in folder.iterdir():
        if file.stem in _FILES:
            require_file(file, "a file of a COLMAP model")
    names = _read_names(folder)
    try:
        model = pycolmap.Reconstruction(str(folder))
        images = [image for image in model.images.values() if image.has_pose]
    except (RuntimeError, ValueError, OSError, IndexError) as error:
        raise InputError(f"{folder}: expected a COLMAP model; found {error}") from error
    require(bool(images), str(folder), "photographs with a pose", "none")
    cameras = [
        _make_camera(folder, names.get(image.image_id, image.name), image, model.cameras[image.camera_id])
        for image in images
    ]
    return CameraFile.of(cameras, Convention())


def _read_names(folder: Path) -> dict[int, str]:
    """Names of photographs in ``images.txt`` by id, since pycolmap truncates them at a space."""
    path = folder / "images.txt"
    if (folder / "images.bin").exists() or not path.exists():
        return {}
    lines = path.read_text(encoding="utf-8", errors="replace").strip().splitlines()
    lines = [line for line in lines if not line.startswith("#")]
    # Every second line contains points.
    images = [fields for line in lines[::2] if len(fields := line.split(maxsplit=9)) == 10]
    return {int(fields[0]): fields[9].rstrip() for fields in images if fields[0].isdecimal()}


def _make_camera(folder: Path, name: str, image, camera) -> StoredCamera:
    """Convert pycolmap's image (with a pose) and its camera; raises InputError for other camera models
    than ``_MODELS``."""
    origin = f"{folder}: {name}"
    model = camera.model.name
    require(model in _MODELS, origin, f"a camera model among {', '.join(_MODELS)}", model)
    values = dict(zip(_MODELS[model].split(), camera.params, strict=True))
    if "f" in values:
        values["fx"] = values["fy"] = values.pop("f")
    lens = pinhole(*(values.pop(name) for name in ("fx", "fy", "cx", "cy")))
    pose = image.cam_from_world().matrix()
    fields = {"K": lens, "R": pose[:, :3], "T": pose[:, 3], "size": [camera.width, camera.height]}
    return read_camera(name, Entries(origin, {**fields, **values, "fisheye": "FISHEYE" in model}))
