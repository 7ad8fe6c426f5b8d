"""Configurable data sets of rendered people: generated ones and scans."""

import functools
import hashlib
import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar, Literal

from pydantic import Field

from ghgs_lit.config import options
from ghgs_lit.config.options import Options, Size, Text, Workers
from ghgs_lit.data.dataset import DataSet, required_folder
from ghgs_lit.data.layout import Rendered, read_split, split_names
from ghgs_lit.data.reader import PHASES
from ghgs_lit.data.sampling import RING_VIEW, TargetProtocol
from ghgs_lit.errors import InputError
from ghgs_people import bench, figures
from ghgs_people.jobs import (
    ACTIVE,
    PersonSource,
    RenderOptions,
    SyntheticSource,
    everything,
    identity,
    render_people,
)
from ghgs_people.rig import Rig, RigOptions
from ghgs_people.scans import ScanSource

# Seed of built-in people, which form one numbered population
_PEOPLE_SEED = 0
# Seed of heights, yaws and lights, and of the split of scans by fraction
_SEED = 0


class _Renderable(Rendered):
    """Base of data sets that this package renders with a ring of cameras around each subject."""

    ring: ClassVar[int] = Rig.positions

    render: RenderOptions = RenderOptions()
    """Renderings of each person."""
    render_workers: Workers | None = None
    """Number of rendering processes; null: one per core; 0: render in this process."""

    rig: RigOptions = RigOptions()
    """The ring of cameras around each subject."""


#: Index of the first validation person, above those of all training people.
FIRST_VAL = 1_000_000


class People(Options):
    """Numbers of people; increasing them extends the same cache."""

    group = "data.people"

    train: int = Field(64, ge=1, lt=FIRST_VAL)
    """People of training."""
    val: int = Field(8, ge=1, lt=FIRST_VAL)
    """People of validation."""


class ActivePeople(Options):
    """Numbers of additional people in poses of sport and dance; increasing them extends the same cache."""

    group = "data.active"

    train: int = Field(0, ge=0, lt=FIRST_VAL)
    """People of training."""
    val: int = Field(0, ge=0, lt=FIRST_VAL)
    """People of validation."""


class Synthetic(_Renderable):
    """Generated people, rendered on first use into a cache folder named after all their settings."""

    pixel_centers: ClassVar[str] = "half"

    name: Text = "synthetic"
    rig: RigOptions = RigOptions(height=None)
    size: Size = 140
    render: RenderOptions = RenderOptions(size=140)
    people: People = People()
    """Numbers of people."""
    active: ActivePeople = ActivePeople()
    """Numbers of additional people in poses of sport and dance."""
    cache_dir: options.PathText | None = None
    """Folder of the caches; null: $GHGS_CACHE or ~/.cache/ghgs_lit."""

    @property
    def root(self) -> str:
        """Cache folder, named after all settings that the photographs depend on."""
        made_with = identity(self.rig.build(), self.render, _PEOPLE_SEED)
        made_with["people"] = people_version()
        key = hashlib.sha256(json.dumps(made_with, sort_keys=True).encode()).hexdigest()[:16]
        cache = self.cache_dir or os.environ.get("GHGS_CACHE") or "~/.cache/ghgs_lit"
        try:
            return str(Path(cache).expanduser() / f"synthetic-{key}")
        except RuntimeError:  # the user has no home directory in the container
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
        """Render the people that are missing in the cache.

        Args:
            splits: ``train``, ``val`` or splits of frozen people (:mod:`.bench`).

        Raises:
            InputError: frozen people differ from their definition, or people cannot be rendered.
        """
        frozen = [split for split in splits if split in bench.SPLITS]
        for split in frozen:
            made_with = everything(self.rig.build(), self.render)
            bench.check_settings(split, {"people_seed": _PEOPLE_SEED, **made_with})
        names = {phase: self.subject_names(phase) for phase in splits}
        source = SyntheticSource(_PEOPLE_SEED)
        rig = self.rig.build()
        render_people(Path(self.root), names, source, rig, self.render, _PEOPLE_SEED, self.render_workers)
        for split in frozen:
            bench.check_photographs(split, self.reader(split))

    def check_targets(self, targets: TargetProtocol) -> None:
        needed = {RING_VIEW} | targets.view_numbers
        if needed - set(self.render.views):
            raise InputError(
                f"data.render.views: expected {sorted(needed)} for targets={targets.name}; "
                f"found {list(self.render.views)}"
            )


class Scans(DataSet, _Renderable):
    """Scans, rendered from ``source`` into ``root`` by :meth:`make`."""

    #: Fraction of the scans, at least one, for val if no split is given.
    val_fraction: ClassVar[float] = 0.1

    name: Text = "scans"
    size: Size = 140
    render: RenderOptions = RenderOptions(lights="none")
    source: options.PathText | None = None
    """Folder of textured meshes <id>/<id>.obj or .glb; only needed for rendering."""
    split: options.PathText | dict[str, tuple[Text, ...] | None] | None = None
    """Subjects of train and val: a folder with split_train.txt and split_val.txt, or {train: [0000-0425],
    val: [0426-0525]}. null: the folders train and val of root; when rendering, the split files in source,
    else a tenth for val (thuman2: 0.19)."""
    pixel_centers: Literal["half", "integer", "auto"] = "half"
    """Pixel centres of the intrinsics in files. half: rendered by this package; integer: by the published
    scripts; auto: detected."""

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
        """Folder of the scans.

        Raises:
            InputError: ``source`` is null.
        """
        return required_folder("data.source", "a folder of scans", self.source)

    def scans(self) -> PersonSource:
        """Loader of the scans."""
        return ScanSource(self.source_folder)

    def make(self) -> None:
        """Render the scans of the split that are missing in ``root``.

        Raises:
            InputError: ``source`` or ``root`` is null, a scan is invalid, or ``root`` contains other data.
        """
        source = self.scans()
        root = required_folder("data.root", "a folder", self.root)
        names = split_names(self.source_folder, source.names(), self.split, self.val_fraction, _SEED)
        render_people(root, names, source, self.rig.build(), self.render, _SEED, self.render_workers)


@functools.cache
def people_version() -> str:
    """Hash of the code and assets that generate people, for the names of caches."""
    digest = hashlib.sha256()
    folder = Path(figures.__file__).parent
    for path in sorted(folder.rglob("*")):
        if path.is_file() and path.suffix != ".pyc":
            digest.update(path.relative_to(folder).as_posix().encode() + path.read_bytes())
    return digest.hexdigest()[:16]
