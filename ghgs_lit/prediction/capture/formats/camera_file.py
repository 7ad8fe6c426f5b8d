"""What a file of cameras gives."""

from dataclasses import dataclass

from ghgs_lit.prediction.capture.calibration import Convention, StoredCamera


@dataclass(frozen=True)
class CameraFile:
    """The cameras of a file by name, what their numbers mean by its format, and the format's name."""

    cameras: dict[str, StoredCamera]
    convention: Convention
    format: str


def by_name(cameras: list[StoredCamera]) -> dict[str, StoredCamera]:
    """Cameras by name; names of photographs lose folder and suffix, where they still differ."""
    short = [_stem(camera.name) for camera in cameras]
    names = short if len(set(short)) == len(short) else [camera.name for camera in cameras]
    return dict(zip(names, cameras, strict=True))


def _stem(name: str) -> str:
    last = name.replace("\\", "/").rpartition("/")[2]
    stem, dot, suffix = last.rpartition(".")
    return stem if dot and suffix.lower() in ("jpg", "jpeg", "png", "tif", "tiff", "bmp", "webp") else last
