"""Lightning DataModules over rendered people: generated ones and scans."""

import functools
import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ghgs_lit.config.settings import from_config
from ghgs_lit.data.datamodule import PHASES, PhotographsDataModule
from ghgs_lit.data.layout import Layout
from ghgs_lit.data.sampling import TargetProtocol, ViewProtocol
from ghgs_lit.errors import InputError, choice, require
from ghgs_lit.synthesis import people
from ghgs_lit.synthesis.jobs import RenderSettings, Source, SyntheticSource, identity, render_people
from ghgs_lit.synthesis.rig import Rig
from ghgs_lit.synthesis.scans import ScanSource, split_names


def default_cache_dir() -> Path:
    """``$GHGS_CACHE``, or ``~/.cache/ghgs_lit``."""
    return Path(os.environ.get("GHGS_CACHE") or "~/.cache/ghgs_lit").expanduser()


class RenderedDataModule(PhotographsDataModule):
    """Data in the rendered layout at ``root`` (see :mod:`ghgs_lit.data.layout`).

    Args:
        root: folder with ``train`` and ``val``.
        body_models: folders of bodies, first found.
        pixel_centers: ``half``, ``integer`` or ``auto``, of the renderer that made the files.
        other: as for :class:`PhotographsDataModule`.
    """

    def __init__(
        self,
        root: str | None,
        views: ViewProtocol | Mapping[str, Any],
        targets: TargetProtocol | Mapping[str, Any],
        size: int | Sequence[int],
        name: str = "rendered",
        body_models: Sequence[str] = ("smpl", "smplx"),
        pixel_centers: str = "half",
        **other: Any,
    ) -> None:
        choice("data.pixel_centers", pixel_centers, ("half", "integer", "auto"))
        super().__init__(root, views, targets, size, name, **other)
        self.pixel_centers, self.body_models = pixel_centers, tuple(body_models)

    def subject_names(self, phase: str) -> list[str] | None:
        """Names of a phase, or None: all that are found."""
        return None

    def layout_options(self, phase: str) -> dict[str, Any]:
        """How :class:`Layout` is to read a phase."""
        return {
            "names": self.subject_names(phase),
            "limit": self.limit[phase],
            "pixel_centers": self.pixel_centers,
            "body_models": self.body_models,
            "cache_mb": self.cache_images_mb,
        }

    def reader(self, phase: str, size: tuple[int, int] | None, strict: bool = True) -> Layout:
        return Layout(self.folder, phase, size, **self.layout_options(phase), strict=strict)


class SyntheticDataModule(RenderedDataModule):
    """Generated people, rendered on first use and kept in a cache named after all their settings.

    Args:
        people: how many, ``{train: n, val: n}``; more of them later extend the same cache.
        people_seed: the family of people.
        rig, render: :class:`Rig` and :class:`RenderSettings` or their mappings.
        cache_dir: null for ``$GHGS_CACHE`` or ``~/.cache/ghgs_lit``.
        render_workers: rendering processes (null: one a core).
    """

    # Index of the first validation person: training people never reach it.
    VAL_OFFSET = 1_000_000

    def __init__(
        self,
        people: Mapping[str, int],
        views: ViewProtocol | Mapping[str, Any],
        targets: TargetProtocol | Mapping[str, Any],
        size: int | Sequence[int],
        people_seed: int = 0,
        rig: Rig | Mapping[str, Any] | None = None,
        render: RenderSettings | Mapping[str, Any] | None = None,
        cache_dir: str | None = None,
        render_workers: int | None = None,
        **rendered: Any,
    ) -> None:
        self.rig = from_config(Rig, "data.rig", rig or {})
        super().__init__(
            root=None, views=views, targets=targets, size=size, ring=self.rig.positions, **rendered
        )
        for phase in PHASES:
            count = people.get(phase, 0)
            require(0 < count < self.VAL_OFFSET, f"data.people.{phase}", "at least 1", count)
        self.people, self.render_workers = dict(people), render_workers
        self.source = SyntheticSource(people_seed)
        self.render = from_config(RenderSettings, "data.render", render or {})
        _check_vids(self.targets, self.render)
        settings = {**identity(self.rig, self.render, people_seed), "people": people_version()}
        key = hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:16]
        cache = Path(cache_dir).expanduser() if cache_dir else default_cache_dir()
        self.root = str(cache / f"synthetic-{key}")

    def subject_names(self, phase: str) -> list[str]:
        first = 0 if phase == "train" else self.VAL_OFFSET
        return [f"p{first + i:07d}" for i in range(self.people[phase])]

    def prepare_data(self) -> None:
        """Render the people that the cache lacks."""
        names = {phase: self.subject_names(phase) for phase in PHASES}
        render_people(
            Path(self.root), names, self.source, self.rig, self.render, self.source.seed, self.render_workers
        )


class ScansDataModule(RenderedDataModule):
    """Scans in the rendered layout at ``root``; :meth:`render_scans` makes it from meshes in ``source``.

    Args:
        source: folder of textured meshes (:class:`ScanSource`); only for rendering.
        split, val_fraction: which are train and val (:func:`split_names`).
        render_seed: of heights, yaws, lights and of the split by fraction.
        rig, render, render_workers: as for :class:`SyntheticDataModule`.
    """

    def __init__(
        self,
        root: str | None,
        views: ViewProtocol | Mapping[str, Any],
        targets: TargetProtocol | Mapping[str, Any],
        size: int | Sequence[int],
        source: str | None = None,
        split: str | Mapping[str, Sequence[str]] | None = None,
        val_fraction: float = 0.1,
        render_seed: int = 0,
        rig: Rig | Mapping[str, Any] | None = None,
        render: RenderSettings | Mapping[str, Any] | None = None,
        render_workers: int | None = None,
        **rendered: Any,
    ) -> None:
        self.rig = from_config(Rig, "data.rig", rig or {})
        super().__init__(
            root=root, views=views, targets=targets, size=size, ring=self.rig.positions, **rendered
        )
        self.source, self.split, self.val_fraction = source, split, val_fraction
        self.render_seed, self.render_workers = render_seed, render_workers
        self.render = from_config(RenderSettings, "data.render", render or {})

    @property
    def source_folder(self) -> Path:
        if self.source is None:
            raise InputError("data.source: expected a folder of scans; found null")
        return Path(self.source).expanduser()

    def scans(self) -> Source:
        """Where the scans come from."""
        return ScanSource(self.source_folder)

    def render_scans(self) -> int:
        """Render every scan of the split (up to ``limit``) that ``root`` lacks; how many those were."""
        source = self.scans()
        if self.root is None:
            raise InputError("data.root: expected a folder; found null")
        names = split_names(
            self.source_folder, source.names(), self.split, self.val_fraction, self.render_seed
        )
        names = {phase: listed[: self.limit[phase]] for phase, listed in names.items()}
        root = Path(self.root).expanduser()
        return render_people(
            root, names, source, self.rig, self.render, self.render_seed, self.render_workers
        )


@functools.cache
def people_version() -> str:
    """A hash of the code and assets that make people: another generator, another cache."""
    digest = hashlib.sha256()
    folder = Path(people.__file__).parent
    for path in sorted(folder.rglob("*")):
        if path.is_file() and path.suffix != ".pyc":
            digest.update(path.relative_to(folder).as_posix().encode() + path.read_bytes())
    return digest.hexdigest()[:16]


def _check_vids(targets: TargetProtocol, render: RenderSettings) -> None:
    lacking = sorted(({0} | targets.vids) - set(render.vids))
    if lacking:
        raise InputError(
            f"data.render.vids: expected {sorted({0} | targets.vids)} for targets={targets.name}; "
            f"found {list(render.vids)}"
        )
