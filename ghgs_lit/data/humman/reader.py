"""Photographs of HuMMan-Recon v1.0 sequences as they were downloaded.

``<root>/p<subject>_a<action>/`` holds, for the Kinects 000 to 009 and frames that are multiples of 6,
``kinect_color/kinect_<k>/<frame>.png`` (1920 x 1080), ``kinect_mask/`` with the same names (matting: any
value but 0 is the performer), for the test sequences ``kinect_mask_manual/``, ``kinect_depth/`` (640 x 576,
millimetres, frame of the depth camera), ``smpl_params/<frame>.npz`` and ``cameras.json``. Some frames are
missing.
"""

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ghgs_lit.data.decoding import check_center, check_name, read_image, read_map, read_photograph
from ghgs_lit.data.humman.cameras import KINECTS, Calibration, read_calibration
from ghgs_lit.data.humman.depth import surface_points
from ghgs_lit.data.humman.smpl import Body, read_parameters
from ghgs_lit.data.reader import FrameReader
from ghgs_lit.data.view import View, opencv_view
from ghgs_lit.errors import InputError

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class _Frame:
    folder: Path
    cameras: Calibration
    number: int


class HuMManReader(FrameReader):
    """Frames of ``sequences``, each a subject ``<sequence>_<frame>``; positions are the colour cameras.
    InputError: all sequences are missing, cameras are bad, or the body model cannot be loaded.

    Args:
        sequences: names of folders; missing ones are left out.
        frames: numbers of frames; those that a sequence lacks are left out, and of a frame the cameras.
        body: ``smpl``: vertices of the licensed model at ``smpl_model``; ``depth``: points of the depth
            cameras inside all masks; ``none``.
        limit: number of frames in all, the first ones (None: all).
    """

    def __init__(
        self,
        folder: Path,
        sequences: Sequence[str],
        frames: Sequence[int],
        masks: str = "kinect_mask",
        body: str = "none",
        smpl_model: Path | None = None,
        limit: int | None = None,
        strict: bool = True,
    ) -> None:
        super().__init__(strict)
        self.masks, self.body_kind = masks, body
        self._body: Body | None = None
        if body == "smpl":
            with self.collecting():
                self._body = _load_model(smpl_model)
        for name in self.existing(folder, sequences, "p000455_a000986"):
            with self.collecting():
                self._add(folder / name, frames)
        self.subjects = dict(list(self.subjects.items())[:limit])

    def _add(self, path: Path, frames: Sequence[int]) -> None:
        cameras = read_calibration(path / "cameras.json", "color")
        there = {k: _frames_of(path / "kinect_color" / f"kinect_{k:03d}") for k in KINECTS}
        # Not one by one: any number of frames may be asked for.
        numbers = [number for number in sorted(set().union(*there.values())) if number in frames]
        found = {number: tuple(k for k in KINECTS if number in there[k]) for number in numbers}
        if not found:
            raise InputError(
                f"{path / 'kinect_color'}: expected frames such as {frames[0]:06d}.png; found none of "
                f"{len(frames)} (frame numbers are multiples of 6)"
            )
        if len(found) < len(frames):
            log.info("%s: %d of %d frames are there", path, len(found), len(frames))
        for number, positions in found.items():
            if len(positions) < len(KINECTS):
                lacking = sorted(set(KINECTS) - set(positions))
                log.warning("%s: frame %06d lacks kinects %s, left out", path, number, lacking)
            name = check_name(f"{path.name}_{number:06d}")
            self.frames[name] = _Frame(path, cameras, number)
            self.subjects[name] = positions

    def read_view(self, name: str, position: int, view: int, depth: bool) -> View:
        frame = self.frames[name]
        path = _file(frame.folder, "kinect_color", position, frame.number)
        image = read_photograph(path)
        mask = self._mask(frame, position, image.shape[:2])
        intrinsics = frame.cameras.intrinsics[position]
        check_center(path, intrinsics, *image.shape[:2])
        return opencv_view(image, mask, intrinsics, frame.cameras.extrinsics[position])

    def read_body(self, name: str) -> np.ndarray | None:
        frame = self.frames[name]
        if self.body_kind == "depth":
            masks = {position: self._mask(frame, position) for position in self.subjects[name]}
            depth_cameras = read_calibration(frame.folder / "cameras.json", "depth")
            return surface_points(frame.folder, frame.number, depth_cameras, frame.cameras, masks)
        if self._body is None:
            return None
        return self._body.vertices(read_parameters(frame.folder / "smpl_params" / f"{frame.number:06d}.npz"))

    def place(self, name: str, position: int, view: int) -> str:
        frame = self.frames[name]
        return str(_file(frame.folder, self.masks, position, frame.number))

    def _mask(self, frame: _Frame, position: int, size: tuple[int, int] | None = None) -> np.ndarray:
        path = _file(frame.folder, self.masks, position, frame.number)
        if size is None:
            image = read_image(path)
            size = (image.height, image.width)
        return read_map(path, size) != 0


def _load_model(path: Path | None) -> Body:
    if path is None:
        raise InputError(
            "data.smpl_model: expected the licensed SMPL_NEUTRAL.pkl for body=smpl; found null "
            "(body=depth takes points of the depth cameras in its place; body=none with "
            "loss.weights.chamfer=0 trains without)"
        )
    return Body(path)


def _file(folder: Path, kind: str, kinect: int, number: int) -> Path:
    return folder / kind / f"kinect_{kinect:03d}" / f"{number:06d}.png"


def _frames_of(folder: Path) -> set[int]:
    if not folder.is_dir():
        return set()
    return {int(p.stem) for p in folder.iterdir() if p.suffix == ".png" and p.stem.isdecimal()}
