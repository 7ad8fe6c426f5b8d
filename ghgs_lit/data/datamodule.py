"""LightningDataModule of all data sets."""

import dataclasses
import logging
import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import torch
from lightning import LightningDataModule, Trainer
from torch.utils.data import DataLoader

from ghgs_lit.config.registry import read_node
from ghgs_lit.data.augmentation import Augmentation
from ghgs_lit.data.batches import (
    BatchBuilder,
    EvaluationBatches,
    StepSampler,
    TrainingBatches,
    automatic_workers,
    loader_of,
)
from ghgs_lit.data.packed import Packing, folder_of, packed_reader
from ghgs_lit.data.reader import PHASES, PhotographCache
from ghgs_lit.data.sampling import (
    RING_VIEW,
    Sample,
    TargetProtocol,
    TrainingSampler,
    ViewProtocol,
    evaluation_samples,
)
from ghgs_lit.errors import InputError, choice
from ghgs_lit.types import Batch

if TYPE_CHECKING:  # which builds the module
    from ghgs_lit.data.dataset import DataOptions

log = logging.getLogger(__name__)

Targets = TargetProtocol | Mapping[str, Any]


def trained_batches(trainer: Trainer | None, length: int) -> int:
    """Number of batches that each process has trained on so far, also after a resume.

    Args:
        trainer: Lightning's; None: 0 batches.
        length: batches of an epoch, whose last step may have fewer than
            ``accumulate_grad_batches``.
    """
    if trainer is None:
        return 0
    length = min(length, trainer.num_training_batches)  # trainer.limit_train_batches
    epochs, steps = divmod(trainer.global_step, math.ceil(length / trainer.accumulate_grad_batches))
    return epochs * length + steps * trainer.accumulate_grad_batches


def planned_batches(trainer: Trainer | None, length: int) -> float:
    """Number of batches that each process will train on; infinite where nothing limits it.

    Args:
        trainer: its limits count; None: there are none.
        length: batches of an epoch.
    """
    limits = [math.inf]
    if trainer is not None and trainer.max_steps > 0:
        limits.append(trainer.max_steps * trainer.accumulate_grad_batches)
    if trainer is not None and (trainer.max_epochs or -1) > 0:
        limits.append(trainer.max_epochs * length)
    return min(limits)


def _protocols(targets: Targets | Sequence[Targets]) -> list[TargetProtocol]:
    several = targets if isinstance(targets, Sequence) and not isinstance(targets, str) else (targets,)
    return [read_node(protocol, "targets") for protocol in several]


#: Steps of an epoch, at least.
LEAST_STEPS = 100


class PhotographsDataModule(LightningDataModule):
    """Loaders of a data set.

    Args:
        dataset: options of the data set.
        views: choice of the inputs.
        targets: choice of the targets.
        seed: of all that is drawn.
        augmentation: variation of training batches; None: none.

    Raises:
        InputError: an unknown key or impossible value; when data is read, missing or bad files.
    """

    def __init__(
        self,
        dataset: "DataOptions",
        views: ViewProtocol | Mapping[str, Any],
        targets: Targets,
        seed: int = 0,
        augmentation: Augmentation | Mapping[str, Any] | None = None,
    ) -> None:
        super().__init__()
        self.dataset = dataset
        self.views = read_node(views, "views")
        self.targets = read_node(targets, "targets")
        self.augmentation = read_node(augmentation or {}, "augmentation")
        dataset.check_targets(self.targets)
        self.seed = seed
        #: Whether training reads depth maps;
        #: evaluation reads them all the same, for its depth error.
        self.trains_on_depths = True
        self._builders: dict[str, BatchBuilder] = {}

    @property
    def facts(self) -> dict[str, str]:
        """Provenance of the data for results."""
        return {**self.dataset.facts, "resampling": self.dataset.resampling}

    def prepare_data(self, splits: Sequence[str] = PHASES) -> None:
        """Make missing data.

        Args:
            splits: names of splits.

        Raises:
            InputError: the data set has no such split.
        """
        for split in splits:
            choice("split", split, self.dataset.split_names)
        self.dataset.prepare(splits)

    def builder(self, phase: str) -> BatchBuilder:
        """Batch builder of a split, made at its first use.

        Args:
            phase: name of the split.

        Raises:
            InputError: the data set has no such split.
        """
        choice("split", phase, self.dataset.split_names)
        if phase not in self._builders:
            data = self.dataset
            reader = self.dataset.reader(phase)
            inputs = targets = PhotographCache(reader, data.size, data.cache_images_mb, data.resampling)
            if data.target_size not in (None, data.size):
                targets = PhotographCache(reader, data.target_size, data.cache_images_mb, data.resampling)
            self._builders[phase] = BatchBuilder(inputs, targets)
        return self._builders[phase]

    def subjects(self, phase: str) -> dict[str, tuple[int, ...]]:
        """Names and camera positions of the subjects of a phase."""
        return self.builder(phase).inputs.reader.subjects

    def training_sampler(self, targets: TargetProtocol | None = None) -> TrainingSampler:
        """Sampler of training.

        Args:
            targets: choice of the targets; None: this module's.
        """
        data = self.dataset
        protocols = (self.views, self._possible(targets or self.targets))
        numbers = (data.ring, data.batch_size, self.seed, data.class_steps)
        return TrainingSampler(self.subjects("train"), *protocols, *numbers)

    def training_batch(self, step: int) -> Batch:
        """The batch of a single process at ``step``."""
        return self._training_batches(self.training_sampler(), step + 1)[step]

    def _training_batches(
        self,
        sampler: TrainingSampler,
        length: int,
        rank: int = 0,
        world: int = 1,
        builder: BatchBuilder | None = None,
    ) -> TrainingBatches:
        """Batches of training for one process.

        Args:
            sampler: draws samples.
            length: steps of an epoch.
            rank: number of this process.
            world: number of processes.
            builder: reads samples; None: that of ``train``.
        """
        builder = builder or self.builder("train")
        builder = dataclasses.replace(builder, depths=self.trains_on_depths, target_depths=False)
        return TrainingBatches(builder, sampler, self.augmentation, length, rank, world)

    def _packed_builder(self, batches: float, rank: int) -> BatchBuilder:
        """Builder of training batches that reads packed files.

        Args:
            batches: number of those of the whole run.
            rank: number of this process.
        """
        plain = self.builder("train")
        views = max(self.views.training_counts) + self.targets.per_step
        reads = batches * self.dataset.batch_size * views
        inputs = self._packed(plain.inputs, self.trains_on_depths, reads, rank)
        if plain.targets is plain.inputs:
            return BatchBuilder(inputs, inputs)
        return BatchBuilder(inputs, self._packed(plain.targets, False, reads, rank))

    def _packed(self, photographs: PhotographCache, depths: bool, reads: float, rank: int) -> PhotographCache:
        """Photographs of training from packed files.

        Args:
            photographs: as they are read from their own files.
            depths: whether depth maps are read, too.
            reads: number of photographs that the run will read; files that are missing are written
                only where this is more than there are photographs.
            rank: number of this process; the first one says where packed files are.

        Returns:
            The same photographs, from packed files where there are any.
        """
        data = self.dataset
        reader = photographs.reader
        if data.packed_gb <= 0 or not reader.subjects:
            return photographs
        # Photographs that are resized in each step are packed as they are stored.
        size = None if self.augmentation.varies_sizes else photographs.size
        views = tuple(sorted({RING_VIEW, *self.targets.training_views}))
        there = sum(map(len, reader.subjects.values())) * len(views)
        packing = Packing(folder_of(data.folder), size, data.resampling, views, depths, writes=reads > there)
        announce = log.info if rank == 0 else log.debug
        reader = packed_reader(reader, packing, data.packed_gb, announce)
        if reader is photographs.reader:
            return photographs
        # the system keeps pages
        return PhotographCache(reader, photographs.size, 0, data.resampling)

    def train_dataloader(self) -> DataLoader:
        """Batches of one epoch, which continues where the last one ended."""
        sampler = self.training_sampler()
        world = self.trainer.world_size if self.trainer else 1
        rank = self.trainer.global_rank if self.trainer else 0
        once = math.ceil(len(sampler.subjects) / (self.dataset.batch_size * world))
        # Loading processes begin anew with each epoch,
        # for which a GPU would wait where subjects are few.
        length = self.dataset.steps_per_epoch or once * math.ceil(LEAST_STEPS / once)
        planned = planned_batches(self.trainer, length)
        builder = self._packed_builder(planned, rank)
        batches = self._training_batches(sampler, length, rank, world, builder)
        workers = self.workers(planned)
        if self.dataset.workers == "auto" and rank == 0:
            log.info("data.workers=auto: %d loading processes beside each that trains", workers)
        steps = StepSampler(batches, lambda: trained_batches(self.trainer, length))
        return loader_of(batches, workers, sampler=steps)

    def evaluation_loader(
        self,
        views: int | None = None,
        targets: Targets | Sequence[Targets] | None = None,
        split: str = "val",
        batch_size: int | None = None,
    ) -> DataLoader:
        """One fixed sample for each subject.

        Args:
            views: number of inputs; None: the view protocol's.
            targets: a protocol or its mapping, or several, whose targets follow one another in each
                sample; None: this module's.
            split: name of the subjects' split.
            batch_size: samples of a batch; None: the data set's.

        Raises:
            InputError: the data has no such split, positions or views.
        """
        protocols = _protocols(self.targets if targets is None else targets)
        specs = self._evaluation_samples(self.subjects(split), protocols, views)
        batches = EvaluationBatches(self.builder(split), specs, batch_size or self.dataset.batch_size)
        return loader_of(batches, self.workers(len(batches)))

    def evaluation_batch(
        self,
        subject: str,
        split: str = "val",
        views: int | None = None,
        targets: Targets | Sequence[Targets] | None = None,
    ) -> Batch:
        """The sample of one subject; no other is read.

        Args:
            subject: name of the subject.
            split: its split.
            views: number of inputs; None: the view protocol's.
            targets: as for :meth:`evaluation_loader`, but None gives a batch without targets.
        """
        protocols = [] if targets is None else _protocols(targets)
        available = {subject: self.subjects(split)[subject]}
        return self.builder(split).batch(self._evaluation_samples(available, protocols, views))

    def _evaluation_samples(
        self, subjects: Mapping[str, tuple[int, ...]], protocols: Sequence[TargetProtocol], views: int | None
    ) -> list[Sample]:
        """Fixed samples, one for each subject.

        Args:
            subjects: camera positions by name.
            protocols: choices of targets, which follow one another in each sample.
            views: number of inputs; None: the view protocol's.
        """
        data = self.dataset
        count = self.views.evaluation_count if views is None else views
        possible = [self._possible(protocol) for protocol in protocols]
        return evaluation_samples(subjects, count, possible, data.ring, self.seed, data.evaluation_positions)

    def val_dataloader(self) -> DataLoader:
        return self.evaluation_loader()

    def _possible(self, targets: TargetProtocol) -> TargetProtocol:
        if self.dataset.static_cameras and targets.view_numbers != {RING_VIEW}:
            raise InputError(
                f"targets: expected cameras for data={self.dataset.name}, as with targets=cameras "
                f"evaluation.targets=[cameras]; found {targets.name}, which asks for views between cameras"
            )
        return targets

    def workers(self, batches: float) -> int:
        """Number of loading processes, by :func:`automatic_workers` where ``data.workers``
        does not say it.

        Args:
            batches: number of batches that are loaded; infinite where it is not known.
        """
        if self.dataset.workers != "auto":
            return self.dataset.workers
        if self.trainer is None:
            return automatic_workers(batches, 1, torch.cuda.is_available())
        on_gpu = self.trainer.strategy.root_device.type != "cpu"
        return automatic_workers(batches, self.trainer.num_devices, on_gpu)
