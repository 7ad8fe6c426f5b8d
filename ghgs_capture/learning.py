"""Data set of the instants of a sequence: one camera is the target, the others are inputs.

Each camera is the target in turn. Masks and cameras are those that a prediction of the sequence would use;
instants with a mask that still fails are left out."""

import functools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import ClassVar

import numpy as np

from ghgs_capture.agreement import CORRECTION, Agreement, doubt_of_masks
from ghgs_capture.capture import Capture
from ghgs_lit.config.options import PathText, Size, Text
from ghgs_lit.data.dataset import DataOptions
from ghgs_lit.data.reader import Reader
from ghgs_lit.data.view import View
from ghgs_lit.errors import InputError, require
from ghgs_lit.files import write_atomically
from ghgs_lit.geometry.frame import Frame
from ghgs_lit.parsing import read_json

LISTING = "instants.json"  #: Names of the instants of each phase; written last
#: One in this many instants, three at most, is held out for validation
_EVERY = 5
_MOST_MEASURED = 3


def splits_of(names: Sequence[str]) -> dict[str, list[str]]:
    """Split instants into training and validation.

    Args:
        names: names of at least two instants, in their order.

    Returns:
        Names by phase, ``train`` and ``val``.

    Raises:
        InputError: there are fewer than two.
    """
    require(len(names) > 1, "images", "two instants or more to learn from, whose masks agree", len(names))
    count = min(max(len(names) // _EVERY, 1), _MOST_MEASURED)
    measured = {names[round((i + 0.5) * len(names) / count - 0.5)] for i in range(count)}
    return {"train": [n for n in names if n not in measured], "val": [n for n in names if n in measured]}


def agrees(capture: Capture) -> bool:
    """Whether an instant is fit for training: each of its masks agrees with the others."""
    agreement = Agreement.of(capture)
    return agreement is None or not agreement.failed.any()


def write_instant(capture: Capture, folder: Path, size: tuple[int, int]) -> None:
    """Write the crops of an instant for training.

    Args:
        capture: an instant with corrected masks and cameras, and gains if known.
        folder: folder of all instants, to which ``<name>.npz`` is written.
        size: (height, width) of the crops in pixels.
    """
    batch = capture.batch(size, CORRECTION if doubt_of_masks(capture, size) else 0)
    batch = Frame.of(batch).enter(batch)
    images = (255 * batch.images[0]).round().byte().movedim(1, -1)
    mattes = (255 * batch.alpha[0]).round().byte()
    cameras = batch.cameras[0]
    arrays = (images, mattes, cameras.intrinsics.float(), cameras.extrinsics.float())
    names = ("images", "mattes", "intrinsics", "extrinsics")
    stored = {name: each.numpy() for name, each in zip(names, arrays, strict=True)}
    write_atomically(folder / f"{capture.name}.npz", lambda path: _save(path, stored))


def _save(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    with path.open("wb") as file:
        np.savez(file, **arrays)


class InstantReader(Reader):
    """Reader of a capture's instants.

    In validation each camera of an instant is the target once: the subject ``<instant>/<camera>`` has this
    camera at its last position.

    Args:
        folder: folder of the instants.
        names: names of the instants of the phase.
        cameras: names of the cameras, in the order of the crops.
        phase: ``train`` or ``val``.
    """

    def __init__(self, folder: Path, names: Sequence[str], cameras: Sequence[str], phase: str) -> None:
        super().__init__()
        self._folder = folder
        self._first: dict[str, tuple[str, int]] = {}
        for name in names:
            if phase == "train":
                self._first[name] = name, 0
                continue
            for target, camera in enumerate(cameras):
                self._first[f"{name}/{camera}"] = name, target + 1
        self.subjects = dict.fromkeys(self._first, tuple(range(len(cameras))))

    def read_view(self, name: str, position: int, view: int, depth: bool) -> View:
        """See :meth:`Reader.read_view`.

        Args:
            name: name of the subject.
            position: index of the camera, starting at the first one of the subject.
            view: always 0.
            depth: ignored, since depths are unknown.
        """
        instant, first = self._first[name]
        stored = _read_crops(self._folder / f"{instant}.npz")
        camera = (first + position) % len(stored["images"])
        matte = stored["mattes"][camera]
        matrices = (stored[key][camera] for key in ("intrinsics", "extrinsics"))
        return View(stored["images"][camera], matte > 127, None, *matrices, matte)

    def read_body(self, name: str) -> np.ndarray | None:
        return None


@functools.lru_cache(maxsize=64)
def _read_crops(path: Path) -> dict[str, np.ndarray]:
    """Crops of an instant, cached for its further views."""
    with np.load(path) as stored:
        return dict(stored)


class Instants(DataOptions):
    """Instants of a capture on which ``ghgs adapt`` trains; each camera in turn is the target."""

    static_cameras: ClassVar[bool] = True
    name: Text = "instants"
    size: Size = 252
    root: PathText | None = None
    """Folder of the instants, written by ``ghgs adapt``."""
    cameras: tuple[Text, ...] = ()
    """Names of the cameras, in their order."""

    @property
    def ring(self) -> int:
        return len(self.cameras)

    def reader(self, phase: str) -> InstantReader:
        listing = self.folder / LISTING
        if not listing.exists():
            raise InputError(f"{listing}: expected the instants that ghgs adapt has written; found none")
        return InstantReader(self.folder, read_json(listing)[phase], self.cameras, phase)
