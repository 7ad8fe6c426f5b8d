"""A folder of photographs or videos with a calibration: one instant, or many."""

import functools
import itertools
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ghgs_capture.calibration import Convention, StoredCamera, calibrate, quarter_turn
from ghgs_capture.crops import Photograph
from ghgs_capture.formats import CameraFile, read_cameras
from ghgs_capture.frames import Source, VideoFrame, find_frames, has_videos
from ghgs_capture.masks import mask_path, matte_of_background, matte_of_file, segmenter
from ghgs_capture.photographs import (
    Pixels,
    compose_names,
    find_image,
    find_instants,
    fits_stored,
    read_pixels,
)
from ghgs_lit.config import nodes
from ghgs_lit.data.decoding import check_mask
from ghgs_lit.errors import InputError, require
from ghgs_lit.runtime.cores import allowed_cores

if TYPE_CHECKING:  # PyTorch is imported while photographs are decoded
    import torch

MIN_PHOTOGRAPHS = 3  #: Minimum number of photographs of an instant that lacks others


@dataclass(frozen=True)
class CaptureFolder:
    """A user's photographs with their calibration: ``photographs(instant)`` for each of ``instants``.

    Args:
        images: folder of photographs or videos named after their cameras, or of one such folder of
            photographs for each instant.
        cameras: the calibration, in one of :data:`ghgs_capture.formats.FORMATS`.
        masks: folder of masks, organised and named like the photographs; None: the first available
            source of ``backgrounds``, ``segment``, masks next to the photographs (``<name>_mask.png``),
            masks that the calibration names, alpha.
        backgrounds: folder of photographs without the subject, named after the cameras.
        segment: a segmenter of :data:`ghgs_capture.masks.SEGMENTERS`.
        calibration: corrections of what the file omits or states wrongly
            (:class:`ghgs_lit.config.nodes.Calibration`).
        sequence: instants to use, and how videos are synchronised
            (:class:`ghgs_lit.config.nodes.SequenceOptions`).

    Raises:
        InputError: a folder or file is missing or wrong.
    """

    images: str | Path
    cameras: str | Path
    masks: str | Path | None = None
    backgrounds: str | Path | None = None
    segment: str | None = None
    calibration: Mapping[str, Any] = field(default_factory=dict)
    sequence: Mapping[str, Any] = field(default_factory=dict)
    #: Views of one instant that are decoded or being decoded
    _begun: dict[str, dict[str, Future]] = field(default_factory=dict, init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        for name in ("images", "cameras", "masks", "backgrounds"):
            if isinstance(path := getattr(self, name), str | Path):
                object.__setattr__(self, name, Path(path).expanduser())
        for name, kind in (("calibration", nodes.Calibration), ("sequence", nodes.SequenceOptions)):
            object.__setattr__(self, name, kind.read(getattr(self, name), name))
        for name in ("masks", "backgrounds"):
            path = getattr(self, name)
            require(path is None or path.is_dir(), name, "a folder", str(path))
        # reads the calibration and lists the photographs, which raises for missing files
        _ = self.paths

    @functools.cached_property
    def file(self) -> CameraFile:
        """Cameras as stored in the file."""
        return read_cameras(self.cameras, self.calibration.format)

    @functools.cached_property
    def convention(self) -> Convention:
        """Convention of the stored numbers: the format's, with the user's corrections."""
        return self.file.convention.with_options(vars(self.calibration))

    @functools.cached_property
    def _all_paths(self) -> dict[str, dict[str, Source]]:
        """``{instant: {camera: path or frame}}`` of all instants."""
        folder = self.images
        cameras = self.file.cameras
        part = self.sequence
        names = compose_names(self.calibration.names)
        if has_videos(folder, cameras, names):
            return find_frames(folder, self.masks, cameras, names, self.convention, part.sync, part.step)
        require(part.sync is None, "sequence.sync", "null for photographs", part.sync)
        return find_instants(folder, cameras, names)

    @functools.cached_property
    def paths(self) -> dict[str, dict[str, Source]]:
        """``{instant: {camera: path or frame}}`` of the instants that ``sequence`` selects."""
        all_instants = self._all_paths
        part = self.sequence
        names = list(all_instants)[part.start : part.stop : part.step]
        expected = f"a part of {len(all_instants)} instants"
        require(bool(names), "sequence.start", expected, f"none from {part.start} to {part.stop}")
        return {name: all_instants[name] for name in names}

    @functools.cached_property
    def missing(self) -> dict[str, dict[str, str]]:
        """``{instant: {camera: why}}`` of photographs that are missing or could not be read so far."""
        cameras = dict.fromkeys(itertools.chain.from_iterable(self._all_paths.values()))
        missing = {}
        for instant, paths in self.paths.items():
            missing[instant] = {name: "there is no photograph" for name in cameras if name not in paths}
        return missing

    @property
    def instants(self) -> list[str]:
        """Names of the instants, in their order."""
        return list(self.paths)

    @property
    def input_files(self) -> list[Path]:
        """All possible input files: photographs and other files in their folders, calibration, masks,
        backgrounds."""
        folders = set()
        for paths in self.paths.values():
            folders |= {path.parent if isinstance(path, Path) else self.images for path in paths.values()}
        given = [path for path in (self.cameras, self.masks, self.backgrounds) if isinstance(path, Path)]
        files = list(itertools.chain.from_iterable(folder.iterdir() for folder in folders))
        for path in given:
            files += path.rglob("*") if path.is_dir() else [path]
        return files

    def photographs(self, instant: str) -> tuple[Photograph, ...]:
        """Decode one instant and apply the calibration.

        Args:
            instant: one of :attr:`instants`.

        Returns:
            At least two photographs, undistorted and upright.

        Raises:
            InputError: as for :meth:`decode`, or a photograph's aspect ratio differs from that of its
                calibration.
        """
        views = self.decode(instant)
        self._begun.clear()  # they take much memory
        upright = {n: partial(self.photograph, n, *view, self.convention) for n, view in views.items()}
        return tuple(self._complete(instant, upright).values())

    def decode(self, instant: str) -> dict[str, tuple[StoredCamera, Pixels, np.ndarray]]:
        """Decode the views of one instant, as shown, before the calibration is applied.

        They are cached until the next call of :meth:`photographs`, or until another instant is decoded.

        Args:
            instant: one of :attr:`instants`.

        Returns:
            ``{camera: (camera, photograph, matte [h, w] uint8)}``.

        Raises:
            InputError: a photograph or mask is missing or invalid; in a sequence, an instant may lack
                photographs (:attr:`missing`) if at least ``MIN_PHOTOGRAPHS`` remain.
        """
        self.begin(instant)
        return self._complete(instant, {name: view.result for name, view in self._begun[instant].items()})

    def _complete(self, instant: str, views: Mapping[str, Callable[[], Any]]) -> dict[str, Any]:
        """Values of all views; in a sequence, views that fail are left out if enough others remain."""
        values = {}
        for name, view in views.items():
            try:
                values[name] = view()
            except InputError as error:
                if len(self.instants) == 1:
                    raise
                self.missing[instant][name] = str(error)
        missing = self.missing[instant] if len(self.instants) > 1 else {}
        why = "; ".join(f"{name}: {text}" for name, text in missing.items())
        least = MIN_PHOTOGRAPHS if missing else 2
        count = f"{len(values)} ({why})" if missing else len(values)
        require(len(values) >= least, f"{self.images}: {instant}", f"{least} photographs or more", count)
        return values

    def begin(self, instant: str) -> None:
        """Decode the views of an instant in background threads; :meth:`decode` waits for them.

        Args:
            instant: one of :attr:`instants`; cached views of another are discarded.
        """
        if instant in self._begun:
            return
        self._begun.clear()
        # Segmentation uses its own threads, and one session.
        pool = ThreadPoolExecutor(allowed_cores() if self.segment is None else 1)
        self._begun[instant] = {
            name: pool.submit(self._view, name, path) for name, path in self.paths[instant].items()
        }
        pool.shutdown(wait=False)

    def _view(self, name: str, path: Source) -> tuple[StoredCamera, Pixels, np.ndarray]:
        """Decode one view; raises InputError if its photograph or mask is missing or invalid."""
        camera = self.file.cameras[name]
        pixels = read_pixels(path) if isinstance(path, Path) else path.pixels()
        matte = self._matte(name, camera, path, pixels)
        mask = self._mask(path) if self.backgrounds is None else None
        check_mask(mask or path, matte > 127)
        return camera, pixels, matte

    def _mask(self, path: Source) -> Source | None:
        """Mask file of a photograph, in the folder of masks or next to the photograph, or None."""
        masks = self.images if self.masks is None else self.masks
        return mask_path(path, self.images, masks) if isinstance(path, Path) else path.mask

    def photograph(
        self, name: str, camera: StoredCamera, pixels: Pixels, matte: np.ndarray, convention: Convention
    ) -> Photograph:
        """Undistort one view and turn it upright, with its camera converted by a convention.

        Args:
            name: name of the camera.
            camera: the camera as stored in its file.
            pixels: the photograph as shown.
            matte: [h, w] uint8, of the photograph as shown.
            convention: convention of the camera's numbers.

        Raises:
            InputError: the photograph's aspect ratio differs from that of the calibration, or
                undistortion leaves nothing of the subject.
        """
        image = pixels.image
        turns = 0
        if fits_stored(pixels, camera, convention.exif):
            turns = pixels.turns
            image = np.rot90(image, -turns)
            matte = np.rot90(matte, -turns)
        size = image.shape[:2]
        calibration = calibrate(camera, convention, size)
        if calibration.distortion.any():
            from ghgs_lit.geometry.undistortion import undistort

            # Everything that undistortion depends on, as the key of a cache for all instants.
            lens = tuple(calibration.intrinsics.ravel()), tuple(calibration.distortion), calibration.fisheye
            image, matte = undistort(image, matte, _grid(*lens, *size))
            expected = "a lens distortion that leaves some of the subject"
            lens = calibration.distortion
            require(bool((matte > 127).any()), camera.origin, expected, lens.tolist())
        upright = quarter_turn(calibration, turns, size)
        image = np.rot90(image, turns)
        matte = np.rot90(matte, turns)
        return Photograph(name, image, matte, upright.intrinsics, upright.extrinsics)

    def _matte(self, name: str, camera: StoredCamera, path: Source, pixels: Pixels) -> np.ndarray:
        """Matte [h, w] uint8 of a photograph as shown, from the first available source; raises InputError
        if there is none, or if the user's source lacks this photograph."""
        mask = self._mask(path)
        if self.masks is not None:
            require(mask is not None, f"{self.masks}", f"a mask of {path}", "none")
        elif self.backgrounds is not None:
            background = find_image(self.backgrounds, name)
            expected = f"a photograph {name} without the subject"
            require(background is not None, f"{self.backgrounds}", expected, "none")
            return matte_of_background(pixels, background)
        elif self.segment is not None:
            return _segmenter(self.segment)(pixels)
        mask = mask or camera.mask
        if isinstance(mask, VideoFrame):
            return mask.matte(pixels)
        if mask is not None:
            return matte_of_file(mask, pixels)
        if pixels.alpha is not None:
            return pixels.alpha
        raise InputError(
            f"{path}: expected a mask of the subject: masks=<folder>, backgrounds=<folder without it>,"
            f" segment=rembg, <name>_mask beside the photograph, or an alpha channel; found none"
        )


_segmenter = functools.cache(segmenter)


@functools.lru_cache(maxsize=16)
def _grid(intrinsics: tuple, distortion: tuple, fisheye: bool, height: int, width: int) -> "torch.Tensor":
    """Cached :func:`ghgs_lit.geometry.undistortion.undistorting_grid`; ``intrinsics`` are the nine numbers
    of the matrix, in pixels."""
    from ghgs_lit.geometry.undistortion import undistorting_grid

    return undistorting_grid(np.reshape(intrinsics, (3, 3)), np.array(distortion), height, width, fisheye)
