"""Layout on disk of rendered THuman2.0 data, by this package's or another renderer.

``<root>/<phase>/`` with phase ``train`` or ``val`` contains, for each ring position and view number::

    img/<id>_<position:03d>/<view>.jpg             image on black (.png is read, too)
    mask/<id>_<position:03d>/<view>.png            subject where channel 0 is above half of its maximum
    alpha/<id>_<position:03d>/<view>.png           optional; 8 bits, the share of each pixel that shows the
                                                   subject, by which the image is premultiplied
    depth/<id>_<position:03d>/<view>.png           optional; uint16, 2^15 / z, 0 where unknown
    parm/<id>_<position:03d>/<view>_intrinsic.npy  3 x 3 in pixels of the stored image
    parm/<id>_<position:03d>/<view>_extrinsic.npy  3 x 4 or 4 x 4, world to camera, metres, OpenCV axes
    smpl/<id>/vertices.npy                         optional (or smplx/): vertices of the body [n, 3]

This package's renderer also writes ``<root>/rendering/`` with ``plan.json`` (the requested subjects of
each phase) and ``done/<phase>/<subject>`` (an empty file for each complete subject, written last). Data
without ``rendering/`` comes from another renderer and counts as complete.
"""

import itertools
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ghgs_lit.data.dataset import DataOptions
from ghgs_lit.data.decoding import (
    check_extrinsics,
    check_intrinsics,
    read_array,
    read_map,
    read_photograph,
    read_vertices,
)
from ghgs_lit.data.reader import PHASES, Reader
from ghgs_lit.data.view import View
from ghgs_lit.errors import InputError, require
from ghgs_lit.parsing import find_path, normalize_name, read_json, read_text, require_folder

#: Folder with split files, or ids by phase.
Split = str | Path | Mapping[str, Sequence[str] | None]
#: Folder of the renderer's records.
FOLDER = "rendering"


@dataclass(frozen=True)
class Completeness:
    """The renderer's records of which subjects of the data set at ``root`` are complete."""

    root: Path

    @property
    def folder(self) -> Path:
        return self.root / FOLDER

    @property
    def rendered_here(self) -> bool:
        """Whether this package rendered the data set."""
        return self.folder.is_dir()

    @property
    def plan(self) -> dict[str, list[str]]:
        """Requested subjects of each phase, complete or not."""
        path = self.folder / "plan.json"
        plan = read_json(path) if path.exists() else {}
        subjects = plan.values() if isinstance(plan, dict) else [plan]
        for names in subjects:
            fits = isinstance(names, list) and all(isinstance(name, str) for name in names)
            require(fits, str(path), "lists of subjects by phase", plan)
        return plan

    def marker(self, phase: str, name: str) -> Path:
        """File that marks a subject as complete."""
        return self.folder / "done" / phase / name

    def missing(self, phase: str, names: Sequence[str]) -> list[str]:
        """Those subjects among ``names`` that are not completely rendered; none if another renderer made the
        data."""
        return [name for name in names if not self.marker(phase, name).exists()] if self.rendered_here else []


_IMAGE_SUFFIXES = (".jpg", ".png", ".jpeg")
#: Folders that contain a folder for each position.
_KINDS = ("img", "mask", "alpha", "depth", "parm")
_POSITION = re.compile(r"(.+)_(\d{3,})")
#: Folders of bodies; the first one that exists is read.
_BODY_MODELS = ("smpl", "smplx")


class Rendered(DataOptions):
    """Base options for data in the rendered layout; subclasses define ``root`` and ``pixel_centers``."""

    @property
    def facts(self) -> dict[str, str]:
        return {**super().facts, "pixel_centers": self.pixel_centers}

    def subject_names(self, phase: str) -> list[str] | None:
        """Names of the subjects to read in a phase; None: all that exist."""
        return None

    def has(self, phase: str) -> bool:
        names = self.subject_names(phase)
        if names is None:
            return (self.folder / phase).is_dir() or bool(Completeness(self.folder).plan.get(phase))
        return len(names) > 0

    def reader(self, phase: str) -> "Layout":
        return Layout(self.folder, phase, self.subject_names(phase), self.pixel_centers)


class Layout(Reader):
    """Reader of one phase of a rendered data set.

    Args:
        phase: ``train`` or ``val``.
        names: subjects to read; those that are not in the phase's folder are read from the other one, as
            the split may have changed; None: all.
        pixel_centers: the renderer's convention: ``half`` (+0.5, as in this package), ``integer`` (as in
            the published scripts) or ``auto`` (integer unless this package rendered the data).

    Raises:
        InputError: the root or phase is missing, empty, not completely rendered, or lacks one of
            ``names``; without ``names``, a subject is in both phases.
    """

    def __init__(
        self, root: str | Path, phase: str, names: Sequence[str] | None = None, pixel_centers: str = "half"
    ) -> None:
        super().__init__()
        root = Path(root).expanduser()
        require_folder(root, "the root of a rendered data set")
        complete = Completeness(root)
        integer = pixel_centers == "auto" and not complete.rendered_here
        self._shift = 0.5 if integer or pixel_centers == "integer" else 0.0
        self._folders: dict[str, Path] = {}
        images = root / phase / "img"
        stored = {p: _positions(root / p / "img") for p in (phase, *PHASES)}
        if names is None:
            both = sorted(stored["train"].keys() & stored["val"].keys())
            if both:
                found = f"{both[0]!r} in both"
                raise InputError(f"{root}: expected each subject in train or in val; found {found}")
            names = sorted({*stored[phase], *complete.plan.get(phase, [])})
            stored = {phase: stored[phase]}
        if not any(stored.values()):
            require_folder(images, "a folder <id>_<position> for every camera")
        if not names:
            raise InputError(f"{images}: expected folders <id>_<position>; found none")
        missing = []
        for name in map(normalize_name, names):
            home = next((p for p in stored if name in stored[p]), phase)
            if name in stored[home] and not complete.missing(home, [name]):
                self.subjects[name] = tuple(sorted(stored[home][name]))
                self._folders[name] = root / home
            else:
                missing.append(name)
        if missing:
            raise InputError(
                f"{images}: expected {len(names)} whole subjects; found {len(names) - len(missing)} "
                f"({missing[0]} is missing or half-rendered: render again to finish)"
            )

    def place(self, name: str, position: int, view: int) -> str:
        return str(self._folder(name, "mask", position) / f"{view}.png")

    def views_at(self, name: str, position: int) -> list[int]:
        files = self._folder(name, "img", position).iterdir()
        images = [path for path in files if path.suffix.lower() in _IMAGE_SUFFIXES]
        return sorted(int(path.stem) for path in images if path.stem.isdecimal())

    def sources(self, name: str) -> Iterator[Path | str]:
        yield f"principal points moved by {self._shift}"
        for position in self.subjects[name]:
            for kind in _KINDS:
                folder = self._folder(name, kind, position)
                yield from folder.iterdir() if folder.is_dir() else ()

    def files(self, name: str) -> Iterator[Path]:
        positions = self.subjects[name]
        views = sorted(set().union(*(self.views_at(name, position) for position in positions)))
        for position, view in itertools.product(positions, views):
            yield self._file(name, "img", position, str(view), _IMAGE_SUFFIXES)
            yield self._file(name, "mask", position, f"{view}.png")
            yield self._file(name, "parm", position, f"{view}_intrinsic.npy")
            yield self._file(name, "parm", position, f"{view}_extrinsic.npy")

    def body_place(self, name: str) -> Path:
        folder = self._folders[name]
        files = [f"{model}/{name}/vertices.npy" for model in _BODY_MODELS]
        return next((path for file in files if (path := find_path(folder, file))), folder / files[0])

    def read_body(self, name: str) -> np.ndarray | None:
        path = self.body_place(name)
        return read_vertices(path) if path.exists() else None

    def read_view(self, name: str, position: int, view: int, depth: bool) -> View:
        """Read an image with its mask, camera and optional maps, see :meth:`Reader.read_view`."""
        image = read_photograph(self._file(name, "img", position, str(view), _IMAGE_SUFFIXES))
        size = image.shape[:2]
        mask = read_map(self._file(name, "mask", position, f"{view}.png"), size)
        inverse = None
        path = self._file(name, "depth", position, f"{view}.png")
        if depth and path.exists():
            inverse = read_map(path, size)
            require(inverse.dtype == np.uint16, str(path), "16 bits of inverse depth", inverse.dtype.name)
        matte = None
        path = self._file(name, "alpha", position, f"{view}.png")
        if path.exists():
            matte = read_map(path, size)
            require(matte.dtype == np.uint8, str(path), "8 bits of grey", matte.dtype.name)
        path = self._file(name, "parm", position, f"{view}_intrinsic.npy")
        intrinsics = check_intrinsics(path, read_array(path, [(3, 3)]))
        path = self._file(name, "parm", position, f"{view}_extrinsic.npy")
        extrinsics = check_extrinsics(path, read_array(path, [(3, 4), (4, 4)]))
        intrinsics[:2, 2] += self._shift
        matrices = (matrix.astype(np.float32) for matrix in (intrinsics, extrinsics))
        # A threshold of half the maximum fits 0/1, 0/255 and compressed masks alike.
        return View(image, mask > mask.max() / 2, inverse, *matrices, matte)

    def _file(self, name: str, kind: str, position: int, file: str, suffixes: Sequence[str] = ("",)) -> Path:
        """Path of a file of a position in any spelling that exists, otherwise in the usual one; the first
        suffix is preferred."""
        folder = self._folder(name, kind, position)
        return find_path(folder, file, suffixes) or folder / f"{file}{suffixes[0]}"

    def _folder(self, name: str, kind: str, position: int) -> Path:
        name_of_position = f"{kind}/{position_name(name, position)}"
        return find_path(self._folders[name], name_of_position) or self._folders[name] / name_of_position


def position_name(name: str, position: int) -> str:
    """Name of the folder of a subject's ring position."""
    return f"{name}_{position:03d}"


def _positions(images: Path) -> dict[str, list[int]]:
    positions: dict[str, list[int]] = {}
    for entry in images.iterdir() if images.is_dir() else ():
        if match := _POSITION.fullmatch(normalize_name(entry.name)):
            positions.setdefault(match[1], []).append(int(match[2]))
    return positions


def split_names(
    source: Path, names: Sequence[str], split: Split | None, val_fraction: float, seed: int
) -> dict[str, list[str]]:
    """Divide the scans of a folder into ``train`` and ``val``.

    Args:
        source: folder of the scans.
        names: ids of all scans.
        split: see :func:`read_split`; None: the split files in ``source``, or a random split if there are
            none.
        val_fraction: share of ``names`` in ``val`` for a random split, in [0, 1]; at least one scan if
            above 0.
        seed: seed of a random split.

    Returns:
        Ids by phase.

    Raises:
        InputError: the split is missing or malformed, names scans that do not exist, or overlaps.
    """
    if split is None and not (source / "split_train.txt").exists():
        order = np.random.default_rng(seed).permutation(len(names))
        count = max(round(val_fraction * len(names)), val_fraction > 0)
        return {
            "train": [names[i] for i in sorted(order[count:])],
            "val": [names[i] for i in sorted(order[:count])],
        }
    chosen = read_split(source if split is None else split, names)
    for phase, listed in chosen.items():
        if unknown := sorted(set(listed) - set(names)):
            raise InputError(
                f"{split or source}: expected ids of scans in {source}; found {unknown[0]!r} in {phase}"
            )
    return chosen


def read_split(split: Split, names: Sequence[str]) -> dict[str, list[str]]:
    """Read the ids of ``train`` and ``val``.

    Args:
        split: a folder with ``split_train.txt`` and ``split_val.txt`` (one id per line), or a mapping
            from phases to ids and to ranges of ``names`` such as ``0000-0425``.
        names: ids of all scans.

    Raises:
        InputError: the split is missing or malformed, or an id is in both phases.
    """
    if isinstance(split, Mapping):
        place: Path | str = "data.split"
        for phase in PHASES:
            require(split.get(phase) is not None, place, f"a list {phase!r}", split.get(phase))
        chosen = {}
        for phase in PHASES:
            chosen[phase] = []
            for entry in split[phase]:
                chosen[phase] += _expand(entry, names)
    else:
        place = Path(split).expanduser()
        require_folder(place, "a folder with split_train.txt and split_val.txt")
        chosen = {p: read_text(place / f"split_{p}.txt", "one id a line").split() for p in PHASES}
    if both := sorted(set(chosen["train"]) & set(chosen["val"])):
        raise InputError(f"{place}: expected disjoint train and val; found {both[0]!r} in both")
    return chosen


def _expand(entry: str, names: Sequence[str]) -> list[str]:
    """Expand a range of ids to all ``names`` of equal length in it; other entries are ids themselves."""
    first, dash, last = entry.partition("-")
    if not dash:
        return [entry]
    return [name for name in names if len(name) == len(first) and first <= name <= last]
