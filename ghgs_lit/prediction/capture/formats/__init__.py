"""Files of cameras: one module a format, each a function from a path to a :class:`CameraFile`."""

from ghgs_lit.prediction.capture.formats.camera_file import CameraFile
from ghgs_lit.prediction.capture.formats.reading import FORMATS, read_cameras

__all__ = ["FORMATS", "CameraFile", "read_cameras"]
