"""Options and reader of ZJU-MoCap.

``<root>/CoreView_<id>/`` holds ``annots.npy`` (see :mod:`.annotations`), the photographs of each
camera, ``mask_cihp/`` and sometimes ``mask/`` (label maps: any value but 0 is the subject),
``new_vertices/`` and ``vertices/`` (<frame number>.npy: 6890 x 3, metres, world with z up).
"""

import functools
import logging
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Annotated, ClassVar

import numpy as np
from pydantic import AfterValidator, Field, model_validator

from ghgs_lit.config.options import Count, Index, Options, Size, Text
from ghgs_lit.data.dataset import DataSet
from ghgs_lit.data.decoding import check_center, check_name, read_array, read_map, read_photograph
from ghgs_lit.data.reader import FrameReader
from ghgs_lit.data.view import View, half_centers, opencv_view
from ghgs_lit.data.zju_mocap.annotations import Annotations, frame_field, frame_number, read_annotations
from ghgs_lit.errors import InputError
from ghgs_lit.geometry.undistortion import undistort, undistorting_grid
from ghgs_lit.parsing import find_path

log = logging.getLogger(__name__)

BODY_VERTICES = 6890
#: Folders of vertices, of which the first existing one is read.
_BODIES = ("new_vertices", "vertices")


class Frames(Options):
    """Frames of several sequences."""

    sequences: tuple[Annotated[Text | Index, AfterValidator(str)], ...] = Field(min_length=1)
    """Ids, such as 377."""
    frames: tuple[Index, Index, Count]
    """[start, stop, step] of the indices in annots.npy, from 0. A shorter sequence gives the
    frames that it has, as in the published loaders."""

    @model_validator(mode="after")
    def _check(self) -> "Frames":
        self.require(self.frames[0] < self.frames[1], "frames", "[start, stop, step] with start < stop")
        return self


@dataclass(frozen=True)
class _Frame:
    folder: Path
    annotations: Annotations
    index: int

    @property
    def number(self) -> int:
        return frame_number(self.folder / self.annotations.frames[self.index][0])


class ZJUMoCapReader(FrameReader):
    """Chosen frames, each a subject ``CoreView_<id>_<frame number>``; positions are the cameras.

    Missing sequences are left out.

    Args:
        data: options of the data set.
        phase: ``train`` or ``val``.
        strict: raise the first problem of the data, or collect all.

    Raises:
        InputError: all sequences are missing, or annotations are bad.
    """

    def __init__(self, data: "ZJUMoCap", phase: str, strict: bool = True) -> None:
        super().__init__(strict)
        self.data = data
        folder = data.folder
        chosen = getattr(data.split, phase)
        wanted = []
        for some in chosen:
            wanted += [(f"CoreView_{s}", some.frames) for s in some.sequences]
        there = self.existing(folder, [name for name, _ in wanted], phase, wanted[0][0])
        for name, frames in wanted:
            if name in there:
                with self.collecting():
                    self._add(folder / name, frames, data.cameras)
        self.subjects = dict(list(self.subjects.items())[: data.limit.of(phase)])

    def _add(self, path: Path, frames: tuple[int, int, int], cameras: int | None) -> None:
        """Add the frames of a sequence as subjects.

        Args:
            path: folder of the sequence.
            frames: start, stop and step of the wanted indices in ``annots.npy``.
            cameras: number of cameras that are used, the first ones; None: all.

        Raises:
            InputError: annotations are bad, or there are fewer cameras or no such frame.
        """
        annotations = read_annotations(path / "annots.npy")
        count = len(annotations.intrinsics)
        if cameras is not None and cameras > count:
            raise InputError(f"{path / 'annots.npy'}: expected {cameras} cameras; found {count}")
        wanted = range(*frames)
        chosen = [index for index in range(len(annotations.frames)) if index in wanted]
        if not chosen:
            raise InputError(
                f"{path / 'annots.npy'}: expected a frame {wanted.start}; "
                f"found {len(annotations.frames)} frames"
            )
        named = [_Frame(path, annotations, index) for index in chosen]
        named = {check_name(f"{path.name}_{frame.number:06d}"): frame for frame in named}
        if len(chosen) < len(wanted):
            log.info("%s: %d of %d frames (the sequence is shorter)", path, len(chosen), len(wanted))
        self.frames |= named
        self.subjects |= dict.fromkeys(named, tuple(range(count if cameras is None else cameras)))

    def read_view(self, name: str, position: int, view: int, depth: bool) -> View:
        """See :meth:`Reader.read_view`.

        Args:
            name: of the subject, ``CoreView_<id>_<frame number>``.
            position: number of the camera, in the order of ``annots.npy``.
            view: not used; there are no views between cameras.
            depth: not used; the data set has no depth maps.
        """
        frame = self.frames[name]
        photograph = frame.annotations.frames[frame.index][position]
        path = _find(frame.folder, photograph, photograph.suffix)
        image = read_photograph(path)
        mask = self._mask(frame.folder, photograph, image.shape[:2])
        intrinsics = frame.annotations.intrinsics[position]
        check_center(path, intrinsics, *image.shape[:2])
        if self.data.undistorted:
            distortion = frame.annotations.distortions[position]
            grid = undistorting_grid(half_centers(intrinsics), distortion, *image.shape[:2])
            image, matte = undistort(image, mask * np.uint8(255), grid)
            mask = matte > 127
        return opencv_view(image, mask, intrinsics, frame.annotations.extrinsics[position])

    def read_body(self, name: str) -> np.ndarray | None:
        path = self._body(self.frames[name])
        return None if path is None else read_array(path, [(BODY_VERTICES, 3)]).astype(np.float32)

    def sources(self, name: str) -> Iterator[Path | str]:
        frame = self.frames[name]
        yield f"undistorted: {self.data.undistorted}"
        yield frame.folder / "annots.npy"
        for position in self.subjects[name]:
            photograph = frame.annotations.frames[frame.index][position]
            yield _find(frame.folder, photograph, photograph.suffix)
            for masks in self._mask_folders(frame.folder):
                yield _find(masks, photograph, ".png")
        body = self._body(frame)
        yield from () if body is None else (body,)

    def body_place(self, name: str) -> Path:
        frame = self.frames[name]
        return self._body(frame) or frame.folder / _BODIES[0] / f"{frame.number}.npy"

    def _body(self, frame: _Frame) -> Path | None:
        """The file of a frame's vertices, if its sequence has any."""
        folder = next((f for b in _BODIES if (f := frame.folder / b).is_dir()), None)
        return None if folder is None else folder / f"{frame.number}.npy"

    def place(self, name: str, position: int, view: int) -> str:
        frame = self.frames[name]
        photograph = frame.annotations.frames[frame.index][position]
        return str(_find(self._mask_folders(frame.folder)[0], photograph, ".png"))

    def _mask_folders(self, folder: Path) -> list[Path]:
        folders = [path for name in self.data.masks if (path := folder / name).is_dir()]
        if not folders:
            raise InputError(
                f"{folder}: expected a folder of masks, {' or '.join(self.data.masks)}; found none"
            )
        return folders

    def _mask(self, folder: Path, photograph: PurePosixPath, size: tuple[int, int]) -> np.ndarray:
        """The union of a photograph's masks in all configured folders.

        Args:
            folder: of the sequence.
            photograph: path of the photograph, as in ``annots.npy``.
            size: (height, width) of the photograph.

        Returns:
            [h, w] bool.
        """
        paths = [_find(masks, photograph, ".png") for masks in self._mask_folders(folder)]
        return functools.reduce(np.logical_or, [read_map(path, size) != 0 for path in paths])


def _find(folder: Path, photograph: PurePosixPath, suffix: str) -> Path:
    """File of a photograph, under its name or its frame field alone (renamed files of
    313 and 315)."""
    usual = photograph.with_suffix(suffix)
    renamed = usual.with_name(frame_field(photograph) + suffix)
    return find_path(folder, str(usual)) or find_path(folder, str(renamed)) or folder / usual


# Assumed number of cameras if all are used; some sequences have 23.
_ALL = 21


class FramesByPhase(Options):
    """Frames of each phase."""

    train: tuple[Frames, ...] = Field(min_length=1)
    """Sequences and their frames."""
    val: tuple[Frames, ...] = Field(min_length=1)
    """Sequences and their frames."""


class ZJUMoCap(DataSet):
    """Downloaded ZJU-MoCap sequences below ``root``; a subject is one frame of one sequence."""

    published: ClassVar[Mapping[str, int]] = {"train": 6, "val": 3}
    static_cameras: ClassVar[bool] = True

    name: Text = "zju_mocap"
    size: Size = 512
    split: FramesByPhase
    """Sequences of each phase, and which of their frames."""
    cameras: Annotated[int, Field(ge=2)] | None = 20
    """Cameras used of each sequence, the first ones, which make up the ring;
    null: all, a ring of 21."""
    undistorted: bool = True
    """Remove the lens distortion of photographs and masks (SHERF does not, most others do)."""
    masks: tuple[Text, ...] = Field(("mask_cihp",), min_length=1)
    """Folders of label maps; those that a sequence has are united."""

    @property
    def ring(self) -> int:
        return self.cameras or _ALL

    def reader(self, phase: str, strict: bool = True) -> ZJUMoCapReader:
        return ZJUMoCapReader(self, phase, strict)
