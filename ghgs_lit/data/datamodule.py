"""Lightning DataModules over rendered people: generated ones and scans."""

import functools
import hashlib
import json
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from lightning import LightningDataModule
from torch.utils.data import DataLoader, Dataset

from ghgs_lit import people
from ghgs_lit.data.datasets import Assembler, EvaluationBatches, StepSampler, TrainingBatches
from ghgs_lit.data.jobs import RenderSettings, SyntheticSource, identity, render_people
from ghgs_lit.data.layout import Layout
from ghgs_lit.data.rig import Rig
from ghgs_lit.data.sampling import TargetProtocol, TrainingDraws, ViewProtocol, evaluation_draws
from ghgs_lit.data.scans import ScanSource, split_names
from ghgs_lit.data.settings import from_config, image_size
from ghgs_lit.errors import InputError, choice, require
from ghgs_lit.types import Batch

PHASES = ("train", "val")


def default_cache_dir() -> Path:
    """``$GHGS_CACHE``, or ``~/.cache/ghgs_lit``."""
    return Path(os.environ.get("GHGS_CACHE") or "~/.cache/ghgs_lit").expanduser()


class RenderedDataModule(LightningDataModule):
    """Data in the rendered layout at ``root`` (see :mod:`ghgs_lit.data.layout`).

    Args:
        root: folder with ``train`` and ``val``.
        views, targets: protocols (:class:`ViewProtocol`, :class:`TargetProtocol`) or their mappings.
        size, target_size: side or [height, width] in pixels of inputs and targets (null: as inputs).
        batch_size: subjects a step and process. ``steps_per_epoch``: null passes once over the subjects.
        ring: positions on a full ring.
        limit: first subjects of each phase that are used, ``{train: n, val: n}`` (null: all).
        body_vertices: vertices kept of each body (null: all); ``body_models``: folders, first found.
        pixel_centers: ``half`` or ``integer``, of the renderer that made the files.
        apply_mask: black out everything outside the masks.
        cache_images_mb: decoded photographs kept in memory by each process.
        evaluation_positions: input positions by number of views, where not evenly spaced.
        workers: loading processes (0: none).

    Raises:
        InputError: a value that cannot work; in ``setup``, a data set that is missing or bad.
    """

    def __init__(
        self,
        root: str | None,
        views: ViewProtocol | Mapping[str, Any],
        targets: TargetProtocol | Mapping[str, Any],
        size: int | Sequence[int],
        name: str = "rendered",
        target_size: int | Sequence[int] | None = None,
        batch_size: int = 1,
        steps_per_epoch: int | None = None,
        ring: int = 16,
        limit: Mapping[str, int | None] | None = None,
        body_vertices: int | None = 4096,
        body_models: Sequence[str] = ("smpl", "smplx"),
        pixel_centers: str = "half",
        apply_mask: bool = False,
        cache_images_mb: float = 512,
        evaluation_positions: Mapping[int, Sequence[int]] | None = None,
        workers: int = 0,
        pin_memory: bool = False,
        seed: int = 0,
    ) -> None:
        super().__init__()
        require(batch_size >= 1, "data.batch_size", "at least 1", batch_size)
        require(
            steps_per_epoch is None or steps_per_epoch >= 1,
            "data.steps_per_epoch",
            "at least 1 or null",
            steps_per_epoch,
        )
        require(ring >= 2, "data.ring", "at least 2", ring)
        require(
            body_vertices is None or body_vertices >= 1,
            "data.body_vertices",
            "at least 1 or null",
            body_vertices,
        )
        require(workers >= 0, "data.workers", "at least 0", workers)
        choice("data.pixel_centers", pixel_centers, ("half", "integer"))
        self.name, self.root = name, root
        self.views = from_config(ViewProtocol, "views", views)
        self.targets = from_config(TargetProtocol, "targets", targets)
        self.size = image_size("data.size", size)
        self.target_size = self.size if target_size is None else image_size("data.target_size", target_size)
        self.batch_size, self.steps_per_epoch, self.ring = batch_size, steps_per_epoch, ring
        self.limit = _limit(limit)
        self.body_vertices, self.apply_mask = body_vertices, apply_mask
        self.evaluation_positions = {int(k): list(v) for k, v in (evaluation_positions or {}).items()}
        self.workers, self.pin_memory, self.seed = workers, pin_memory, seed
        self._layout_options = {
            "pixel_centers": pixel_centers,
            "body_models": tuple(body_models),
            "cache_mb": cache_images_mb,
        }
        self._assemblers: dict[str, Assembler] = {}

    def subject_names(self, phase: str) -> list[str] | None:
        """Names of a phase, or None: all that are found, up to ``limit``."""
        return None

    def assembler(self, phase: str) -> Assembler:
        """Reads batches of ``train`` or ``val``; made on first use."""
        choice("split", phase, PHASES)
        if phase not in self._assemblers:
            if self.root is None:
                raise InputError("data.root: expected the root of a rendered data set; found null")
            options = {**self._layout_options, "names": self.subject_names(phase), "limit": self.limit[phase]}
            inputs = Layout(self.root, phase, self.size, **options)
            same = self.target_size == self.size
            targets = inputs if same else Layout(self.root, phase, self.target_size, **options)
            self._assemblers[phase] = Assembler(inputs, targets, self.apply_mask, self.body_vertices)
        return self._assemblers[phase]

    def subjects(self, phase: str) -> dict[str, tuple[int, ...]]:
        """Names and ring positions of the subjects of a phase."""
        return self.assembler(phase).inputs.subjects

    def train_dataloader(self) -> DataLoader:
        """Batches of one epoch; the next one goes on where it ended."""
        draws = self.training_draws()
        world = self.trainer.world_size if self.trainer else 1
        rank = self.trainer.global_rank if self.trainer else 0
        length = self.steps_per_epoch or math.ceil(len(draws.subjects) / (self.batch_size * world))
        batches = TrainingBatches(self.assembler("train"), draws, length, rank, world)
        return self._loader(batches, sampler=StepSampler(batches, self._first_step))

    def training_draws(self) -> TrainingDraws:
        """What training sees at each step."""
        subjects = self.subjects("train")
        return TrainingDraws(subjects, self.views, self.targets, self.ring, self.batch_size, self.seed)

    def training_batch(self, step: int) -> Batch:
        """The batch of a single process at ``step``."""
        return self.assembler("train").batch(self.training_draws().batch(step))

    def _first_step(self) -> int:
        """Batches that each process has trained on so far, also after a restart from a checkpoint."""
        if self.trainer is None:
            return 0
        return self.trainer.global_step * self.trainer.accumulate_grad_batches

    def evaluation_loader(
        self,
        views: int | None = None,
        targets: str | Mapping[str, Any] | TargetProtocol | None = None,
        split: str = "val",
        batch_size: int | None = None,
    ) -> DataLoader:
        """One sample a subject of ``split``, always the same ones.

        ``views``: number of inputs (null: the protocol's); ``targets``: a protocol or the name of one
        (null: this module's; another name: that protocol with its default values).
        """
        if isinstance(targets, str):
            targets = self.targets if targets == self.targets.name else TargetProtocol(targets)
        targets = self.targets if targets is None else from_config(TargetProtocol, "targets", targets)
        assembler = self.assembler(split)
        count = views or self.views.evaluation_count
        draws = evaluation_draws(
            assembler.inputs.subjects, count, targets, self.ring, self.seed, self.evaluation_positions
        )
        return self._loader(EvaluationBatches(assembler, draws, batch_size or self.batch_size))

    def val_dataloader(self) -> DataLoader:
        return self.evaluation_loader()

    def test_dataloader(self) -> DataLoader:
        return self.evaluation_loader()

    def _loader(self, batches: Dataset, **options) -> DataLoader:
        return DataLoader(
            batches,
            batch_size=None,
            collate_fn=_as_is,
            num_workers=self.workers,
            persistent_workers=self.workers > 0,
            pin_memory=self.pin_memory,
            **options,
        )


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
        split: str | None = None,
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

    def render_scans(self) -> int:
        """Render every scan of the split (up to ``limit``) that ``root`` lacks; how many those were."""
        for key in ("source", "root"):
            if getattr(self, key) is None:
                raise InputError(f"data.{key}: expected a folder; found null")
        source = ScanSource(Path(self.source).expanduser())
        names = split_names(source.folder, source.names(), self.split, self.val_fraction, self.render_seed)
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


def _limit(limit: Mapping[str, int | None] | None) -> dict[str, int | None]:
    limit = {phase: None for phase in PHASES} | dict(limit or {})
    for phase, count in limit.items():
        choice("data.limit key", phase, PHASES)
        require(count is None or count >= 1, f"data.limit.{phase}", "at least 1 or null", count)
    return limit


def _as_is(batch: Batch) -> Batch:
    """Items are batches already."""
    return batch
