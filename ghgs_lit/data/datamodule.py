"""The LightningDataModule that all data sets share: protocols, draws, batches, loaders."""

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import torch
from lightning import LightningDataModule
from torch.utils.data import DataLoader, Dataset

from ghgs_lit.config.settings import from_config, image_size
from ghgs_lit.data.batches import Assembler, EvaluationBatches, StepSampler, TrainingBatches
from ghgs_lit.data.reader import Reader
from ghgs_lit.data.sampling import (
    CAMERAS,
    RING_VID,
    TargetProtocol,
    TrainingDraws,
    ViewProtocol,
    evaluation_draws,
)
from ghgs_lit.errors import InputError, choice, require
from ghgs_lit.types import Batch

PHASES = ("train", "val")


class PhotographsDataModule(LightningDataModule):
    """Photographs of people, read by what :meth:`reader` gives: all that a data set has to say.

    Args:
        root: folder of the data.
        views, targets: protocols (:class:`ViewProtocol`, :class:`TargetProtocol`) or their mappings.
        size, target_size: side or [height, width] in pixels of inputs and targets (null: as inputs).
        batch_size: samples a step and process. ``steps_per_epoch``: null passes once over the subjects.
        ring: positions on a full ring.
        limit: first subjects of each phase that are used, ``{train: n, val: n}`` (null: all).
        body_vertices: vertices kept of each body (null: all).
        depths: whether depth maps of the inputs are read, where the data has any.
        apply_mask: black out everything outside the masks.
        cache_images_mb: decoded photographs kept in memory by each process.
        evaluation_positions: input positions by number of views, where not evenly spaced.
        workers: loading processes (0: none).

    Raises:
        InputError: a value that cannot work; in ``setup``, a data set that is missing or bad.
    """

    # Subjects of each phase in the publication, where there is one.
    published: ClassVar[Mapping[str, int]] = {}
    # Whether cameras stand still: there are no views between them to be targets.
    still: ClassVar[bool] = False

    def __init__(
        self,
        root: str | None,
        views: ViewProtocol | Mapping[str, Any],
        targets: TargetProtocol | Mapping[str, Any],
        size: int | Sequence[int],
        name: str,
        target_size: int | Sequence[int] | None = None,
        batch_size: int = 1,
        steps_per_epoch: int | None = None,
        ring: int = 16,
        limit: Mapping[str, int | None] | None = None,
        body_vertices: int | None = 4096,
        depths: bool = True,
        apply_mask: bool = False,
        cache_images_mb: float = 512,
        evaluation_positions: Mapping[int, Sequence[int]] | None = None,
        workers: int = 0,
        pin_memory: bool = False,
        seed: int = 0,
    ) -> None:
        super().__init__()
        _at_least_1("data.batch_size", batch_size)
        for key, value in (("steps_per_epoch", steps_per_epoch), ("body_vertices", body_vertices)):
            require(value is None or value >= 1, f"data.{key}", "at least 1 or null", value)
        require(ring >= 2, "data.ring", "at least 2", ring)
        require(workers >= 0, "data.workers", "at least 0", workers)
        require(cache_images_mb >= 0, "data.cache_images_mb", "at least 0", cache_images_mb)
        self.name, self.root = name, root
        self.views = from_config(ViewProtocol, "views", views)
        self.targets = from_config(TargetProtocol, "targets", targets)
        self.size = image_size("data.size", size)
        self.target_size = self.size if target_size is None else image_size("data.target_size", target_size)
        self.depths = depths
        self.batch_size, self.steps_per_epoch, self.ring = batch_size, steps_per_epoch, ring
        self.limit = _limit(limit)
        self.body_vertices, self.apply_mask = body_vertices, apply_mask
        self.cache_images_mb = cache_images_mb
        self.evaluation_positions = {int(k): list(v) for k, v in (evaluation_positions or {}).items()}
        self.workers, self.pin_memory, self.seed = workers, pin_memory, seed
        self._assemblers: dict[str, Assembler] = {}

    def reader(self, phase: str, size: tuple[int, int] | None, strict: bool = True) -> Reader:
        """The photographs of ``train`` or ``val`` at ``size``; ``strict`` as for :class:`Reader`."""
        raise NotImplementedError

    def miniature(self, people: Mapping[str, int], size: int, seed: int) -> list[Path]:
        """Write a small data set in the published layout: ``people`` of each phase, photographs scaled so
        that their longer side has ``size`` pixels. Returns the folders that were written."""
        raise InputError(f"task=miniature: expected a data set with a published layout; found {self.name}")

    def inspections(self) -> Sequence[Callable[[], None]]:
        """What task=check is to look at beside the photographs: each call raises InputError if it is bad.

        They run in other processes (functions of a module, or partials of such).
        """
        return []

    def people(self, reader: Reader) -> int:
        """How many people a reader has; where a person is drawn in several frames, fewer than subjects."""
        return len(reader.subjects)

    @property
    def folder(self) -> Path:
        """The folder of the data.

        Raises:
            InputError: ``root`` is null or no folder.
        """
        if self.root is None:
            raise InputError("data.root: expected the folder of the data set; found null")
        folder = Path(self.root).expanduser()
        if not folder.is_dir():
            raise InputError(f"{folder}: expected the folder of the data set; found no such folder")
        return folder

    def assembler(self, phase: str) -> Assembler:
        """Reads batches of ``train`` or ``val``; made on first use."""
        choice("split", phase, PHASES)
        if phase not in self._assemblers:
            inputs = self.reader(phase, self.size)
            same = self.target_size == self.size
            targets = inputs if same else self.reader(phase, self.target_size)
            self._assemblers[phase] = Assembler(
                inputs, targets, self.apply_mask, self.body_vertices, self.depths
            )
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
        subjects, targets = self.subjects("train"), self._possible(self.targets)
        return TrainingDraws(subjects, self.views, targets, self.ring, self.batch_size, self.seed)

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
            known = {CAMERAS.name: CAMERAS, self.targets.name: self.targets}
            targets = known.get(targets) or TargetProtocol(targets)
        targets = self.targets if targets is None else from_config(TargetProtocol, "targets", targets)
        self._possible(targets)
        assembler = self.assembler(split)
        count = views or self.views.evaluation_count
        draws = evaluation_draws(
            assembler.inputs.subjects, count, targets, self.ring, self.seed, self.evaluation_positions
        )
        return self._loader(EvaluationBatches(assembler, draws, batch_size or self.batch_size))

    def _possible(self, targets: TargetProtocol) -> TargetProtocol:
        """``targets``, unless they are views between cameras that stand still."""
        if self.still and targets.vids != {RING_VID}:
            raise InputError(
                f"targets: expected cameras for data={self.name}, as with targets=cameras "
                f"evaluation.targets=[cameras]; found {targets.name}, which asks for views between cameras"
            )
        return targets

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
            pin_memory=self.pin_memory and torch.cuda.is_available(),
            **options,
        )


def _at_least_1(key: str, value: int) -> None:
    require(value >= 1, key, "at least 1", value)


def _limit(limit: Mapping[str, int | None] | None) -> dict[str, int | None]:
    limit = {phase: None for phase in PHASES} | dict(limit or {})
    for phase, count in limit.items():
        choice("data.limit key", phase, PHASES)
        require(count is None or count >= 1, f"data.limit.{phase}", "at least 1 or null", count)
    return limit


def _as_is(batch: Batch) -> Batch:
    """Items are batches already."""
    return batch
