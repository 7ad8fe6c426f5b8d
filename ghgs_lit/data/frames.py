"""Frames of sequences that were captured by the static cameras of a studio."""

import logging
from abc import abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, ClassVar

import numpy as np

from ghgs_lit.data.decoding import (
    check_array,
    check_center,
    check_extrinsics,
    check_intrinsics,
    check_name,
    read_map,
    read_photograph,
)
from ghgs_lit.data.reader import Reader
from ghgs_lit.data.view import View, half_centers
from ghgs_lit.errors import InputError
from ghgs_lit.geometry.undistortion import undistort, undistorting_grid

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Camera:
    """A calibrated camera in OpenCV's conventions.

    Attributes:
        intrinsics: [3, 3] in pixels, with pixel centres at integers.
        extrinsics: [4, 4], world to camera, metres.
        distortion: coefficients k1 k2 p1 p2 (k3), which is removed; None: there is none.
    """

    intrinsics: np.ndarray
    extrinsics: np.ndarray
    distortion: np.ndarray | None = None


def read_camera(place: str, values: Mapping[str, Any], unit: float = 1.0) -> Camera:
    """Check and convert a camera of OpenCV.

    Args:
        place: file of the camera, for messages.
        values: K (3, 3), R (3, 3) and T (3), world to camera.
        unit: unit of T in metres.

    Raises:
        InputError: a value is missing or wrong.
    """
    for name in ("K", "R", "T"):
        if not isinstance(values, Mapping) or name not in values:
            raise InputError(f"{place}: expected {name}; found none")
    rotation = check_array(f"{place}: R", values["R"], [(3, 3)])
    translation = check_array(f"{place}: T", values["T"], [(3,), (3, 1), (1, 3)]).reshape(3, 1) * unit
    extrinsics = check_extrinsics(place, np.concatenate((rotation, translation), 1))
    return Camera(check_intrinsics(f"{place}: K", values["K"]), extrinsics)


def spread(cameras: Sequence[Camera]) -> float:
    """Largest distance in metres of a camera from the first one."""
    centers = np.stack([-one.extrinsics[:3, :3].T @ one.extrinsics[:3, 3] for one in cameras])
    return float(np.linalg.norm(centers - centers[0], axis=-1).max())


@dataclass(frozen=True)
class Frame:
    """A frame of a sequence.

    Attributes:
        folder: folder of the sequence.
        number: number of the frame in file names.
        cameras: all cameras of the sequence.
        positions: indices of the cameras that are read.
        photographs: path of each camera's image, relative to ``folder``.
    """

    folder: Path
    number: int
    cameras: Sequence[Camera]
    positions: tuple[int, ...]
    photographs: Sequence[PurePosixPath]


class FrameReader(Reader):
    """Base reader whose subjects are frames, named ``<sequence>_<frame number>``, and whose positions are
    cameras. Missing sequences are skipped.

    Args:
        phase: ``train`` or ``val``.
        sequences: name and requested frames of each sequence.
        example: name of a sequence, for messages.

    Raises:
        InputError: all sequences are missing, or one is bad.
    """

    #: File of a sequence that contains its cameras.
    calibration: ClassVar[str]

    def __init__(
        self, folder: Path, phase: str, sequences: Sequence[tuple[str, range]], example: str
    ) -> None:
        super().__init__()
        self.frames: dict[str, Frame] = {}
        there = [sequence for sequence in sequences if (folder / sequence[0]).is_dir()]
        if not there:
            some = "such as" if sequences else "beside those of val, such as"
            raise InputError(f"{folder}: expected sequences {some} {example}; found none of {phase}")
        if len(there) < len(sequences):
            log.warning("%s: %d of %d sequences of %s are there", folder, len(there), len(sequences), phase)
        for name, wanted in there:
            found = self.frames_of(folder / name, wanted)
            self.frames |= {check_name(f"{name}_{frame.number:06d}"): frame for frame in found}
            if len(found) < len(wanted):
                log.info("%s: %d of %d frames are there", folder / name, len(found), len(wanted))
        self.subjects = {name: frame.positions for name, frame in self.frames.items()}

    @abstractmethod
    def frames_of(self, folder: Path, wanted: range) -> list[Frame]:
        """Find the requested frames of a sequence.

        Args:
            wanted: numbers of the requested frames.

        Raises:
            InputError: a camera is bad, or none of the frames exists.
        """

    @abstractmethod
    def photograph(self, frame: Frame, position: int) -> Path:
        """Path of an image, which need not exist."""

    @abstractmethod
    def mask(self, frame: Frame, position: int) -> Path:
        """Path of an image's mask, which need not exist; all values except 0 are the subject."""

    def read_view(self, name: str, position: int, view: int, depth: bool) -> View:
        """Read an image on black, see :meth:`Reader.read_view`. There are no views between cameras and no
        depth maps: ``view`` and ``depth`` are not used."""
        frame = self.frames[name]
        path = self.photograph(frame, position)
        image = read_photograph(path)
        size = image.shape[:2]
        mask = read_map(self.mask(frame, position), size) != 0
        camera = frame.cameras[position]
        intrinsics = half_centers(camera.intrinsics)
        check_center(path, camera.intrinsics, *size)
        if camera.distortion is not None:
            grid = undistorting_grid(intrinsics, camera.distortion, *size)
            image, matte = undistort(image, mask * np.uint8(255), grid)
            mask = matte > 127
        image = np.where(mask[..., None], image, 0)
        matrices = (matrix.astype(np.float32) for matrix in (intrinsics, camera.extrinsics))
        return View(image, mask, None, *matrices)

    def sources(self, name: str) -> Iterator[Path]:
        frame = self.frames[name]
        yield frame.folder / self.calibration
        for position in frame.positions:
            yield self.photograph(frame, position)
            yield self.mask(frame, position)

    def place(self, name: str, position: int, view: int) -> str:
        return str(self.mask(self.frames[name], position))
