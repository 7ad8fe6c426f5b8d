"""LightningDataModule of all data sets."""

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
    EvaluationBatches,
    StepSampler,
    TrainingBatches,
    choose_workers,
    make_loader,
)
from ghgs_lit.data.packed import Packs, choose_folder
from ghgs_lit.data.reader import PHASES, Photographs
from ghgs_lit.data.sampling import (
    RING_VIEW,
    Sample,
    TargetProtocol,
    TrainingSampler,
    ViewProtocol,
    evaluation_samples,
)
from ghgs_lit.errors import InputError, require_choice
from ghgs_lit.types import Batch

if TYPE_CHECKING:  # which builds the module
    from ghgs_lit.data.dataset import DataOptions

log = logging.getLogger(__name__)

Targets = TargetProtocol | Mapping[str, Any]


def count_trained_batches(trainer: Trainer | None, length: int) -> int:
    """Count the batches on which each process has trained so far, also after a resume.

    Args:
        trainer: Lightning's Trainer; None: 0 batches.
        length: number of batches of an epoch, whose last step may have fewer than
            ``accumulate_grad_batches``.
    """
    if trainer is None:
        return 0
    length = min(length, trainer.num_training_batches)  # trainer.limit_train_batches
    epochs, steps = divmod(trainer.global_step, math.ceil(length / trainer.accumulate_grad_batches))
    return epochs * length + steps * trainer.accumulate_grad_batches


def count_planned_batches(trainer: Trainer | None, length: int) -> float:
    """Count the batches on which each process will train; infinite without a limit.

    Args:
        trainer: Lightning's Trainer, with limits of steps or epochs; None: no limits.
        length: number of batches of an epoch.
    """
    limits = [math.inf]
    if trainer is not None and trainer.max_steps > 0:
        limits.append(trainer.max_steps * trainer.accumulate_grad_batches)
    if trainer is not None and (trainer.max_epochs or -1) > 0:
        limits.append(trainer.max_epochs * length)
    return min(limits)


def _read_protocols(targets: Targets | Sequence[Targets]) -> list[TargetProtocol]:
    several = targets if isinstance(targets, Sequence) and not isinstance(targets, str) else (targets,)
    return [read_node(protocol, "targets") for protocol in several]


#: Minimum number of steps of an epoch.
LEAST_STEPS = 100


class PhotographsDataModule(LightningDataModule):
    """Loaders of a data set for training and evaluation.

    Args:
        seed: seed of all random numbers.

    Raises:
        InputError: an unknown key or an impossible value; while data is read, a missing or bad file.
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
        #: Whether training reads depth maps; evaluation always does, for its depth error.
        self.trains_on_depths = True
        self._photographs: dict[str, Photographs] = {}

    @property
    def facts(self) -> dict[str, str]:
        """Provenance of the data for results."""
        return {**self.dataset.facts, "resampling": self.dataset.resampling}

    def prepare_data(self, splits: Sequence[str] = PHASES) -> None:
        """Create the missing data of splits.

        Raises:
            InputError: the data set has no such split.
        """
        for split in splits:
            require_choice("split", split, self.dataset.split_names)
        self.dataset.prepare(splits)

    def photographs(self, phase: str) -> Photographs:
        """Images of a split; files are listed at the first call.

        Raises:
            InputError: the data set has no such split.
        """
        require_choice("split", phase, self.dataset.split_names)
        if phase not in self._photographs:
            data = self.dataset
            options = data.size, data.resampling, data.target_size
            self._photographs[phase] = Photographs(data.reader(phase), *options)
        return self._photographs[phase]

    def subjects(self, phase: str) -> dict[str, tuple[int, ...]]:
        """Camera positions of the subjects of a split by name."""
        return self.photographs(phase).reader.subjects

    def training_sampler(self, targets: TargetProtocol | None = None) -> TrainingSampler:
        """Sampler of training.

        Args:
            targets: protocol of the target views; None: this module's.
        """
        data = self.dataset
        protocols = (self.views, self._check_static(targets or self.targets))
        return TrainingSampler(self.subjects("train"), *protocols, data.ring, data.batch_size, self.seed)

    def training_batch(self, step: int) -> Batch:
        """The training batch at ``step`` in a run with a single process."""
        return self.training_batches(step + 1)[step]

    def training_batches(self, length: int, rank: int = 0, world: int = 1) -> TrainingBatches:
        """Training batches of one process.

        Args:
            length: number of steps of an epoch.
        """
        photographs = self.photographs("train")
        parts = (photographs, self.training_sampler(), self.augmentation)
        return TrainingBatches(*parts, length, self.trains_on_depths, rank, world)

    def _use_packs(self, batches: float, rank: int) -> None:
        """Read training images from packed files. Missing files are written only if the run loads more
        images than there are."""
        data = self.dataset
        photographs = self.photographs("train")
        if not data.packed:
            return
        drawn = batches * data.batch_size * (max(self.views.training_counts) + self.targets.per_step)
        views = tuple(sorted({RING_VIEW, *self.targets.training_views}))
        writes = drawn > sum(map(len, photographs.reader.subjects.values())) * len(views)
        folder = choose_folder(data.folder)
        if writes and rank == 0:
            log.info("photographs of training are packed in %s (data.packed=false: not)", folder)
        # With varying sizes images are resized in each step, so they are packed at their stored size.
        varies = self.augmentation.varies_sizes
        for size in {None} if varies else {photographs.size, photographs.target_size}:
            depths = self.trains_on_depths and size in (None, photographs.size)
            options = (folder, size, data.resampling, views, depths, writes)
            photographs.packs[size] = Packs(photographs.reader, *options)

    def train_dataloader(self) -> DataLoader:
        """Loader of one epoch, which continues where the last one ended."""
        subjects = self.subjects("train")
        world = self.trainer.world_size if self.trainer else 1
        rank = self.trainer.global_rank if self.trainer else 0
        once = math.ceil(len(subjects) / (self.dataset.batch_size * world))
        # Workers restart with each epoch, for which a GPU would wait often if there are few subjects.
        length = self.dataset.steps_per_epoch or once * math.ceil(LEAST_STEPS / once)
        planned = count_planned_batches(self.trainer, length)
        self._use_packs(planned, rank)
        batches = self.training_batches(length, rank, world)
        workers = self.workers(planned)
        if self.dataset.workers == "auto" and rank == 0:
            log.info("data.workers=auto: %d loading processes beside each that trains", workers)
        steps = StepSampler(batches, lambda: count_trained_batches(self.trainer, length))
        return make_loader(batches, workers, sampler=steps)

    def evaluation_loader(
        self,
        views: int | None = None,
        targets: Targets | Sequence[Targets] | None = None,
        split: str = "val",
        batch_size: int | None = None,
    ) -> DataLoader:
        """Loader of one fixed sample per subject.

        Args:
            views: number of input views; None: the view protocol's.
            targets: one or several protocols, or their mappings, whose targets are concatenated in each
                sample; None: this module's.
            batch_size: samples of a batch; None: the data set's.

        Raises:
            InputError: the data has no such split, positions or views.
        """
        protocols = _read_protocols(self.targets if targets is None else targets)
        specs = self._evaluation_samples(self.subjects(split), protocols, views)
        batches = EvaluationBatches(self.photographs(split), specs, batch_size or self.dataset.batch_size)
        return make_loader(batches, self.workers(len(batches)))

    def evaluation_batch(
        self,
        subject: str,
        split: str = "val",
        views: int | None = None,
        targets: Targets | Sequence[Targets] | None = None,
    ) -> Batch:
        """Fixed sample of one subject, as a batch; other subjects are not read.

        Args:
            views: number of input views; None: the view protocol's.
            targets: as for :meth:`evaluation_loader`, except that None gives a batch without targets.
        """
        protocols = [] if targets is None else _read_protocols(targets)
        available = {subject: self.subjects(split)[subject]}
        return self.photographs(split).batch(self._evaluation_samples(available, protocols, views))

    def _evaluation_samples(
        self, subjects: Mapping[str, tuple[int, ...]], protocols: Sequence[TargetProtocol], views: int | None
    ) -> list[Sample]:
        """One fixed sample per subject, with the concatenated targets of all protocols."""
        data = self.dataset
        count = self.views.evaluation_count if views is None else views
        possible = [self._check_static(protocol) for protocol in protocols]
        return evaluation_samples(subjects, count, possible, data.ring, self.seed, data.evaluation_positions)

    def val_dataloader(self) -> DataLoader:
        return self.evaluation_loader()

    def _check_static(self, targets: TargetProtocol) -> TargetProtocol:
        if self.dataset.static_cameras and targets.view_numbers != {RING_VIEW}:
            raise InputError(
                f"targets: expected cameras for data={self.dataset.name}, as with targets=cameras "
                f"evaluation.targets=[cameras]; found {targets.name}, which asks for views between cameras"
            )
        return targets

    def workers(self, batches: float) -> int:
        """Number of workers, from :func:`choose_workers` if ``data.workers`` is ``auto``.

        Args:
            batches: number of batches to load; infinite if unknown.
        """
        if self.dataset.workers != "auto":
            return self.dataset.workers
        if self.trainer is None:
            return choose_workers(batches, 1, torch.cuda.is_available())
        on_gpu = self.trainer.strategy.root_device.type != "cpu"
        return choose_workers(batches, self.trainer.num_devices, on_gpu)
