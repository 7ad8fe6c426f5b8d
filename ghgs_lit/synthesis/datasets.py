"""Data sets of rendered people as they are configured: generated people and scans."""

import functools
import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import ClassVar

from ghgs_lit.config.settings import from_config, set_fields
from ghgs_lit.data.dataset import required_folder
from ghgs_lit.data.layout import Rendered
from ghgs_lit.data.reader import PHASES
from ghgs_lit.data.sampling import RING_VIEW, TargetProtocol
from ghgs_lit.data.splits import Split, split_names
from ghgs_lit.errors import InputError, require
from ghgs_lit.synthesis import bench, people
from ghgs_lit.synthesis.jobs import (
    ACTIVE,
    RenderSettings,
    Source,
    SyntheticSource,
    identity,
    render_people,
)
from ghgs_lit.synthesis.rig import Rig
from ghgs_lit.synthesis.scans import ScanSource


@dataclass(frozen=True, kw_only=True)
class _Renderable(Rendered):
    """A data set that this package can render; its ring of cameras is the rig's.

    Attributes:
        rig, render: settings or their mappings.
        render_workers: number of rendering processes (null: one for each core; 0: no further process).
    """

    ring: int = field(init=False, default=16)
    rig: Rig = field(default_factory=Rig)
    render: RenderSettings = field(default_factory=RenderSettings)
    render_workers: int | None = None

    def __post_init__(self) -> None:
        rig = from_config(Rig, "data.rig", self.rig or {})
        render = from_config(RenderSettings, "data.render", self.render or {})
        set_fields(self, rig=rig, render=render, ring=rig.positions)
        super().__post_init__()


@dataclass(frozen=True, kw_only=True)
class Synthetic(_Renderable):
    """Generated people, rendered on first use and kept in a cache folder named after all their settings.

    Attributes:
        people: number of people, ``{train: n, val: n}``; a larger number extends the same cache.
        active: number of further people, in poses of sport and dance, likewise.
        people_seed: seed of the people.
        cache_dir: folder of the caches (null: ``$GHGS_CACHE`` or ``~/.cache/ghgs_lit``).
    """

    # Index of the first validation person: training people never reach it.
    FIRST_VAL: ClassVar[int] = 1_000_000

    root: str = field(init=False, default="")
    people: Mapping[str, int]
    active: Mapping[str, int] = field(default_factory=dict)
    people_seed: int = 0
    cache_dir: str | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        for phase in PHASES:
            count = self.people.get(phase, 0)
            require(0 < count < self.FIRST_VAL, f"data.people.{phase}", "at least 1", count)
            count = self.active.get(phase, 0)
            require(0 <= count < self.FIRST_VAL, f"data.active.{phase}", "at least 0", count)
        settings = {**identity(self.rig, self.render, self.people_seed), "people": people_version()}
        key = hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:16]
        cache = self.cache_dir or os.environ.get("GHGS_CACHE") or "~/.cache/ghgs_lit"
        set_fields(self, root=str(Path(cache).expanduser() / f"synthetic-{key}"))

    @property
    def split_names(self) -> tuple[str, ...]:
        return (*PHASES, bench.SPLIT)

    def split_facts(self, split: str) -> dict[str, str]:
        return super().split_facts(split) | (bench.facts() if split == bench.SPLIT else {})

    def subject_names(self, phase: str) -> list[str]:
        if phase == bench.SPLIT:
            return bench.names()
        first = 0 if phase == "train" else self.FIRST_VAL
        numbers = (("p", self.people[phase]), (ACTIVE, self.active.get(phase, 0)))
        return [f"{kind}{first + i:07d}" for kind, count in numbers for i in range(count)]

    def prepare(self, splits: Sequence[str] = PHASES) -> None:
        """Render the people of ``splits`` that the cache lacks.

        Raises:
            InputError: the people of ``bench`` are not those of its definition (:mod:`.bench`).
        """
        if bench.SPLIT in splits:
            bench.check_settings(asdict(self))
        names = {phase: self.subject_names(phase) for phase in splits}
        source, seed = SyntheticSource(self.people_seed), self.people_seed
        render_people(Path(self.root), names, source, self.rig, self.render, seed, self.render_workers)
        if bench.SPLIT in splits:
            bench.check_photographs(self.reader(bench.SPLIT))

    def check_targets(self, targets: TargetProtocol) -> None:
        needed = {RING_VIEW} | targets.view_numbers
        if needed - set(self.render.views):
            raise InputError(
                f"data.render.views: expected {sorted(needed)} for targets={targets.name}; "
                f"found {list(self.render.views)}"
            )


@dataclass(frozen=True, kw_only=True)
class Scans(_Renderable):
    """Scans in the rendered layout at ``root``; :meth:`render_missing` renders them from ``source``.

    Attributes:
        source: folder of textured meshes (:class:`ScanSource`); only for rendering.
        split, val_fraction: which scans are train and val (:func:`split_names`).
        render_seed: seed of heights, yaws, lights and of the split by fraction.
    """

    source: str | None = None
    split: Split | None = None
    val_fraction: float = 0.1
    render_seed: int = 0

    @property
    def source_folder(self) -> Path:
        return required_folder("data.source", "a folder of scans", self.source)

    def scans(self) -> Source:
        """Where the scans come from."""
        return ScanSource(self.source_folder)

    def render_missing(self) -> int:
        """Render the scans of the split (up to ``limit``) that ``root`` lacks; returns their number."""
        source, seed = self.scans(), self.render_seed
        root = required_folder("data.root", "a folder", self.root)
        names = split_names(self.source_folder, source.names(), self.split, self.val_fraction, seed)
        names = {phase: listed[: self.limit[phase]] for phase, listed in names.items()}
        return render_people(root, names, source, self.rig, self.render, seed, self.render_workers)


@functools.cache
def people_version() -> str:
    """A hash of the code and assets that make people: another generator needs another cache."""
    digest = hashlib.sha256()
    folder = Path(people.__file__).parent
    for path in sorted(folder.rglob("*")):
        if path.is_file() and path.suffix != ".pyc":
            digest.update(path.relative_to(folder).as_posix().encode() + path.read_bytes())
    return digest.hexdigest()[:16]
