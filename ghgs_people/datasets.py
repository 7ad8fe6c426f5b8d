"""Configurable data sets of rendered people: generated people and scans."""

import functools
import hashlib
import json
import os
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, ClassVar, Literal

from pydantic import Field

from ghgs_lit.config import options
from ghgs_lit.config.options import Options, Share, Size, Text, Words, Workers
from ghgs_lit.data.dataset import DataSet, Limit
from ghgs_lit.data.layout import Completeness, Layout, Rendered
from ghgs_lit.data.options import required_folder
from ghgs_lit.data.reader import PHASES
from ghgs_lit.data.sampling import RING_VIEW, TargetProtocol
from ghgs_lit.data.splits import read_split, split_names
from ghgs_lit.errors import InputError
from ghgs_people import bench, figures
from ghgs_people.background import Joining, render_beside
from ghgs_people.capture_rig import CaptureRig, RigCamera
from ghgs_people.jobs import (
    ACTIVE,
    PersonSource,
    RenderOptions,
    SyntheticSource,
    everything,
    identity,
    render_people,
)
from ghgs_people.rig import Fill, Rig, RigOptions
from ghgs_people.scans import ScanSource

# Seed of built-in people: they are one population, numbered.
_PEOPLE_SEED = 0
# Seed of heights, yaws, lights and of the split by fraction of scans.
_SEED = 0
# People in a rig that are rendered before training begins:
# a first run of ``ghgs adapt`` takes minutes.
_FIRST_TRAIN = 8


class _Renderable(Rendered):
    """A data set that this package renders."""

    render: RenderOptions = RenderOptions()
    """What is rendered of each person."""
    render_workers: Workers | None = None
    """Rendering processes; null: one for each core; 0: no further process."""

    @abstractmethod
    def camera_rig(self) -> Rig | CaptureRig:
        """The cameras around each subject."""


class _OnRing(_Renderable):
    """A data set whose cameras are a ring."""

    ring: ClassVar[int] = Rig.positions

    rig: RigOptions = RigOptions()
    """The ring of cameras around each subject."""

    def camera_rig(self) -> Rig:
        return self.rig.build()


#: Index of the first validation person, above those of all training people.
FIRST_VAL = 1_000_000


class People(Options):
    """Numbers of people; larger ones extend the same cache."""

    group = "data.people"

    train: int = Field(64, ge=1, lt=FIRST_VAL)
    """People of training."""
    val: int = Field(8, ge=1, lt=FIRST_VAL)
    """People of validation."""


class ActivePeople(Options):
    """Numbers of further people, in poses of sport and dance; larger ones extend the same cache."""

    group = "data.active"

    train: int = Field(0, ge=0, lt=FIRST_VAL)
    """People of training."""
    val: int = Field(0, ge=0, lt=FIRST_VAL)
    """People of validation."""


class _Generated(_Renderable):
    """Generated people, rendered on first use and kept in a cache folder named after all
    their settings."""

    limit: ClassVar[Limit] = Limit()
    pixel_centers: ClassVar[str] = "half"

    size: Size = 140
    render: RenderOptions = RenderOptions(size=140)
    people: People = People()
    """Number of people."""
    active: ActivePeople = ActivePeople()
    """Number of further people, in poses of sport and dance."""
    cache_dir: options.PathText | None = None
    """Folder of the caches; null: $GHGS_CACHE or ~/.cache/ghgs_lit."""

    @property
    def root(self) -> str:
        """The cache's folder, named after everything that the photographs depend on."""
        made_with = identity(self.camera_rig(), self.render, _PEOPLE_SEED)
        made_with["people"] = people_version()
        key = hashlib.sha256(json.dumps(made_with, sort_keys=True).encode()).hexdigest()[:16]
        cache = self.cache_dir or os.environ.get("GHGS_CACHE") or "~/.cache/ghgs_lit"
        try:
            return str(Path(cache).expanduser() / f"synthetic-{key}")
        except RuntimeError:  # a user that the container does not know
            expected = "a folder, or one in GHGS_CACHE, where there is no home directory"
            raise InputError(f"data.cache_dir: expected {expected}; found {cache}") from None

    @property
    def split_names(self) -> tuple[str, ...]:
        return (*PHASES, *bench.SPLITS)

    def split_facts(self, split: str) -> dict[str, str]:
        return super().split_facts(split) | (bench.facts(split) if split in bench.SPLITS else {})

    def subject_names(self, phase: str) -> list[str]:
        if phase in bench.SPLITS:
            return bench.names(phase)
        first = 0 if phase == "train" else FIRST_VAL
        names = []
        for letter, people in (("p", self.people), (ACTIVE, self.active)):
            names += [f"{letter}{first + i:07d}" for i in range(getattr(people, phase))]
        return names

    def prepare(self, splits: Sequence[str] = PHASES) -> None:
        """Render the people that the cache lacks.

        Args:
            splits: ``train``, ``val`` or frozen people (:mod:`.bench`).

        Raises:
            InputError: frozen people differ from their definition, or people cannot be rendered.
        """
        frozen = [split for split in splits if split in bench.SPLITS]
        for split in frozen:
            made_with = everything(self.camera_rig(), self.render)
            bench.check_settings(split, {"people_seed": _PEOPLE_SEED, **made_with})
        self.render_first({phase: self.subject_names(phase) for phase in splits})
        for split in frozen:
            bench.check_photographs(split, self.reader(split))

    def render_first(self, names: Mapping[str, Sequence[str]]) -> None:
        """Render people that are needed before work begins.

        Args:
            names: of the people of each phase.
        """
        source = SyntheticSource(_PEOPLE_SEED)
        rig = self.camera_rig()
        render_people(Path(self.root), names, source, rig, self.render, _PEOPLE_SEED, self.render_workers)

    def check_targets(self, targets: TargetProtocol) -> None:
        needed = {RING_VIEW} | targets.view_numbers
        if needed - set(self.render.views):
            raise InputError(
                f"data.render.views: expected {sorted(needed)} for targets={targets.name}; "
                f"found {list(self.render.views)}"
            )


class Synthetic(_Generated, _OnRing):
    """Generated people in a ring of cameras."""

    name: Text = "synthetic"
    rig: RigOptions = RigOptions(height=None)


class PeopleInRig(_Generated):
    """Generated people in the rig of a capture, as crops around them: what ``ghgs adapt`` trains
    on. Training waits for the first people only (for all with ``render_workers=0``); the others are
    rendered meanwhile."""

    name: Text = "people_in_rig"
    size: Size = 252
    people: People = People(train=32, val=6)
    active: ActivePeople = ActivePeople(train=8, val=2)
    cameras: Annotated[dict, Words("a mapping of cameras")] = Field({})
    """The cameras of the rig: intrinsics, extrinsics, width and height of each by name."""
    fill: tuple[Fill, Fill] = (0.5, 0.95)
    """[least, greatest] share of its photograph's height that a subject takes in the camera that
    sees it tallest."""

    @property
    def ring(self) -> int:
        return len(self.cameras)

    def subject_names(self, phase: str) -> list[str]:
        """Names sorted by number, so that the first ones are of both kinds.

        Args:
            phase: ``train``, ``val`` or one of the frozen splits.
        """
        return sorted(super().subject_names(phase), key=lambda name: name[1:])

    def render_first(self, names: Mapping[str, Sequence[str]]) -> None:
        """Render people, but of training only the first ones; start to render the others.

        Args:
            names: of the people of each phase.
        """
        if self.render_workers == 0:
            return super().render_first(names)
        trained = list(names.get("train", []))
        root = Path(self.root)
        super().render_first({**names, "train": trained[:_FIRST_TRAIN]})
        render_beside(
            root, trained, SyntheticSource(_PEOPLE_SEED), self.camera_rig(), self.render, _PEOPLE_SEED
        )

    def reader(self, phase: str, strict: bool = True) -> Layout:
        if phase != "train":
            return super().reader(phase, strict)
        names = self.subject_names(phase)
        layout = Layout(
            self.folder, phase, Completeness(self.folder).whole(phase, names) or names, strict=strict
        )
        Joining(layout, names)
        return layout

    def camera_rig(self) -> CaptureRig:
        read = [RigCamera.read(camera, f"data.cameras.{name}") for name, camera in self.cameras.items()]
        return CaptureRig.of(read, self.fill)


class Scans(DataSet, _OnRing):
    """Scans rendered to ``root``; :meth:`render_missing` renders them from ``source``."""

    name: Text = "scans"
    size: Size = 140
    render: RenderOptions = RenderOptions(lights="none")
    source: options.PathText | None = None
    """Folder of textured meshes, <id>/<id>.obj or .glb; only for rendering."""
    split: options.PathText | dict[str, tuple[Text, ...] | None] | None = None
    """Which subjects are train and val: a folder with split_train.txt and split_val.txt, or
    {train: [0000-0425], val: [0426-0525]}. Null: the folders train and val of root; when rendering,
    the split files in source, else a fraction."""
    val_fraction: Share = 0.1
    """Fraction of the scans that is val where no split decides, at least one of them."""
    pixel_centers: Literal["half", "integer", "auto"] = "half"
    """Pixel centres of the files. half: rendered by this package; integer: by the published
    scripts; auto: whichever it was."""

    def subject_names(self, phase: str) -> list[str] | None:
        if self.split is None:
            return None
        rendered = set()
        for part in PHASES:
            images = self.folder / part / "img"
            if images.is_dir():
                rendered |= {position.name.rpartition("_")[0] for position in images.iterdir()}
        return read_split(self.split, sorted(rendered))[phase]

    @property
    def source_folder(self) -> Path:
        """The folder of the scans.

        Raises:
            InputError: ``source`` is null.
        """
        return required_folder("data.source", "a folder of scans", self.source)

    def scans(self) -> PersonSource:
        """The source of the scans."""
        return ScanSource(self.source_folder)

    def make(self) -> None:
        self.render_missing()

    def render_missing(self) -> int:
        """Render the scans of the split (up to ``limit``) that ``root`` lacks.

        Returns:
            Number of scans rendered now.

        Raises:
            InputError: ``source`` or ``root`` is null, a scan is bad,
                or ``root`` holds something else.
        """
        source = self.scans()
        root = required_folder("data.root", "a folder", self.root)
        names = split_names(self.source_folder, source.names(), self.split, self.val_fraction, _SEED)
        names = {phase: listed[: self.limit.of(phase)] for phase, listed in names.items()}
        rig = self.camera_rig()
        workers = self.render_workers
        return render_people(root, names, source, rig, self.render, _SEED, workers)


@functools.cache
def people_version() -> str:
    """A hash of the code and assets that generate people, for the names of caches."""
    digest = hashlib.sha256()
    folder = Path(figures.__file__).parent
    for path in sorted(folder.rglob("*")):
        if path.is_file() and path.suffix != ".pyc":
            digest.update(path.relative_to(folder).as_posix().encode() + path.read_bytes())
    return digest.hexdigest()[:16]
