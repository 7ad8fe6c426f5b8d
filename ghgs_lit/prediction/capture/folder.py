"""A folder of photographs with a calibration: one instant, or many."""

import functools
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ghgs_lit.data.silhouettes import implausible
from ghgs_lit.errors import InputError, choice, require
from ghgs_lit.kernels.cores import allowed_cores
from ghgs_lit.prediction.capture.calibration import (
    Calibration,
    Convention,
    StoredCamera,
    calibrate,
    quarter_turned,
)
from ghgs_lit.prediction.capture.crops import Photograph
from ghgs_lit.prediction.capture.formats import CameraFile, read_cameras
from ghgs_lit.prediction.capture.masks import mask_path, matte_of_background, matte_of_file, segmenter
from ghgs_lit.prediction.capture.photographs import (
    Pixels,
    composed,
    find_instants,
    fits_stored,
    image_named,
    read_pixels,
)

if TYPE_CHECKING:  # photographs are read while PyTorch is imported
    import torch

EXIF = ("auto", "stored", "shown")
_CONVENTION = tuple(f.name for f in fields(Convention))


@dataclass(frozen=True)
class CaptureFolder:
    """``folder.photographs(instant)`` for each of ``folder.instants``.

    Args:
        images: folder of photographs named after their cameras; or of such folders, one for each instant.
        cameras: the calibration, in one of :data:`ghgs_lit.prediction.capture.formats.FORMATS`.
        masks: folder of masks, laid out and named as the photographs; None: ``backgrounds``, ``segment``,
            masks beside the photographs (``<name>_mask.png``) or named by the calibration, alpha channels.
        backgrounds: folder of photographs without the subject, named after the cameras.
        segment: a segmenter of :data:`ghgs_lit.prediction.capture.masks.SEGMENTERS`.
        calibration: what the file does not say, or says wrongly: ``format``; the fields of
            :class:`Convention`; ``exif`` (:func:`fits_stored`); ``names``, the camera of a photograph whose
            name differs, as ``{photograph: camera}``. None and missing keys are as the format has it.

    Raises:
        InputError: a folder or file is missing or wrong.
    """

    images: str | Path
    cameras: str | Path
    masks: str | Path | None = None
    backgrounds: str | Path | None = None
    segment: str | None = None
    calibration: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        known = ("format", "exif", "names", *_CONVENTION)
        unknown = sorted(set(self.calibration) - set(known))
        require(not unknown, "calibration", f"keys among {', '.join(known)}", unknown)
        choice("calibration.exif", self._said("exif", "auto"), EXIF)
        for name in ("masks", "backgrounds"):
            path = getattr(self, name)
            is_folder = path is None or Path(path).expanduser().is_dir()
            require(is_folder, name, "a folder", str(path))
        _ = self.paths  # reads the calibration and lists the photographs: missing files are refused here

    def _said(self, key: str, default: Any) -> Any:
        value = self.calibration.get(key)
        return default if value is None else value

    @functools.cached_property
    def _begun(self) -> dict[str, list[Future]]:
        """The views of one instant that are decoded, or are being decoded."""
        return {}

    @functools.cached_property
    def file(self) -> CameraFile:
        """The cameras as stored."""
        return read_cameras(self.cameras, self._said("format", "auto"))

    @functools.cached_property
    def convention(self) -> Convention:
        """Meaning of the stored numbers: the format's, unless the user says otherwise."""
        said = {name: self._said(name, getattr(self.file.convention, name)) for name in _CONVENTION}
        return Convention(**said)

    @functools.cached_property
    def paths(self) -> dict[str, dict[str, Path]]:
        """``{instant: {camera: path}}``."""
        folder = Path(self.images).expanduser()
        # Numbers, too, are names of cameras.
        names = {composed(str(key)): composed(str(name)) for key, name in self._said("names", {}).items()}
        return find_instants(folder, self.file.cameras, names)

    @property
    def instants(self) -> list[str]:
        """Names of the instants, in their order."""
        return list(self.paths)

    @property
    def input_files(self) -> list[Path]:
        """The files that may be read, such as photographs with what lies beside them, and the calibration."""
        photographs = (path for paths in self.paths.values() for path in paths.values())
        folders = {path.parent for path in photographs}
        given = (self.cameras, self.masks, self.backgrounds)
        given = [Path(path).expanduser() for path in given if path is not None]
        files = [path for folder in folders for path in folder.iterdir()]
        return files + [file for path in given for file in (path.rglob("*") if path.is_dir() else [path])]

    def photographs(self, instant: str) -> tuple[Photograph, ...]:
        """The photographs of one instant, two or more. InputError: a photograph or mask is missing or
        wrong."""
        views = zip(self.paths[instant], self.decode(instant), strict=True)
        self._begun.clear()  # they take much memory
        return tuple(self.photograph(name, *view, self.convention) for name, view in views)

    def decode(self, instant: str) -> list[tuple[StoredCamera, Pixels, np.ndarray]]:
        """Camera, photograph and matte as shown of each view, before the calibration is applied.

        They are kept until :meth:`photographs` has them, or those of another instant are decoded.
        """
        self.begin(instant)
        return [view.result() for view in self._begun[instant]]

    def begin(self, instant: str) -> None:
        """Decode the views of an instant in threads; :meth:`decode` waits for them."""
        if instant in self._begun:
            return
        self._begun.clear()
        # Segmentation has threads of its own, and one session.
        pool = ThreadPoolExecutor(allowed_cores() if self.segment is None else 1)
        self._begun[instant] = [pool.submit(self._view, *view) for view in self.paths[instant].items()]
        pool.shutdown(wait=False)

    def _view(self, name: str, path: Path) -> tuple[StoredCamera, Pixels, np.ndarray]:
        camera, pixels = self.file.cameras[name], read_pixels(path)
        matte = self._matte(name, camera, path, pixels)
        problem = implausible(matte > 127)
        if problem is not None:
            raise InputError(f"{path}: {problem}")
        return camera, pixels, matte

    def photograph(
        self, name: str, camera: StoredCamera, pixels: Pixels, matte: np.ndarray, convention: Convention
    ) -> Photograph:
        """One view without distortion and upright, as a convention has it."""
        image, turns = pixels.image, 0
        if fits_stored(pixels, camera, self._said("exif", "auto")):
            turns = pixels.turns
            image, matte = np.rot90(image, -turns), np.rot90(matte, -turns)
        size = image.shape[:2]
        calibration = calibrate(camera, convention, size)
        if calibration.distortion.any():
            from ghgs_lit.geometry.undistortion import undistort

            image, matte = undistort(image, matte, _grid(_key(calibration), *size))
        calibration = quarter_turned(calibration, turns, size)
        image, matte = np.rot90(image, turns), np.rot90(matte, turns)
        return Photograph(name, image, matte, calibration.intrinsics, calibration.extrinsics)

    def _matte(self, name: str, camera: StoredCamera, path: Path, pixels: Pixels) -> np.ndarray:
        """The matte [h, w] uint8 as the photograph is shown, of the first source that there is."""
        images = Path(self.images).expanduser()
        if self.masks is not None:
            mask = mask_path(path, images, Path(self.masks).expanduser())
            require(mask is not None, f"{self.masks}", f"a mask {path.stem}.png of {path}", "none")
            return matte_of_file(mask, pixels)
        if self.backgrounds is not None:
            background = image_named(Path(self.backgrounds).expanduser(), name)
            expected = f"a photograph {name} without the subject"
            require(background is not None, f"{self.backgrounds}", expected, "none")
            return matte_of_background(pixels, background)
        if self.segment is not None:
            return _segmenter(self.segment)(pixels)
        beside = mask_path(path, images, images)
        named = beside if beside is not None else camera.mask
        if named is not None:
            return matte_of_file(named, pixels)
        if pixels.alpha is not None:
            return pixels.alpha
        raise InputError(
            f"{path}: expected a mask of the subject: masks=<folder>, backgrounds=<folder without it>,"
            f" segment=rembg, {path.stem}_mask.png beside the photograph, or an alpha channel; found none"
        )


_segmenter = functools.cache(segmenter)


def _key(calibration: Calibration) -> tuple:
    """Everything that undistortion depends on, as a key of a cache: many instants share it."""
    return tuple(calibration.intrinsics.ravel()), tuple(calibration.distortion), calibration.fisheye


@functools.lru_cache(maxsize=16)
def _grid(key: tuple, height: int, width: int) -> "torch.Tensor":
    from ghgs_lit.geometry.undistortion import undistorting_grid

    intrinsics, distortion, fisheye = key
    return undistorting_grid(np.reshape(intrinsics, (3, 3)), np.array(distortion), height, width, fisheye)
