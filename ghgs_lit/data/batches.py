"""Datasets whose items are whole :class:`Batch` objects, and their loaders."""

import itertools
import signal
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch.utils.data import DataLoader, Dataset, DistributedSampler

from ghgs_lit.data.augmentation import Augmentation
from ghgs_lit.data.reader import Photographs
from ghgs_lit.data.sampling import Sample, TrainingSampler
from ghgs_lit.runtime.cores import allowed_cores, use_known_start_method
from ghgs_lit.types import Batch

#: Number of batches below which worker processes may take longer to start than they save.
_FEW = 256
#: Maximum number of workers; more wait for the disk.
_MOST = 8


@dataclass(frozen=True)
class TrainingBatches(Dataset):
    """Training batches; item ``step`` is the batch of process ``rank`` of ``world`` at a step of the run.

    Args:
        length: number of steps of an epoch.
        depths: whether depth maps of the inputs are read.
    """

    photographs: Photographs
    sampler: TrainingSampler
    augmentation: Augmentation
    length: int
    depths: bool
    rank: int = 0
    world: int = 1

    def __len__(self) -> int:
        return self.length

    def __getitem__(self, step: int) -> Batch:
        samples = self.sampler.batch(step, self.rank, self.world)
        fixed = self.photographs.size, self.photographs.target_size
        sizes = self.augmentation.sample_sizes(*fixed, self.sampler.seed, step)
        batch = self.photographs.batch(samples, sizes, self.depths, target_depths=False)
        indices = self.sampler.indices(step, self.rank, self.world)
        return self.augmentation.augment(batch, self.sampler.seed, step, indices)


class EvaluationBatches(Dataset):
    """Batches of fixed samples; an item contains consecutive samples with equal target protocols.

    Args:
        batch_size: maximum number of samples of an item.
    """

    def __init__(self, photographs: Photographs, samples: Sequence[Sample], batch_size: int) -> None:
        self.photographs = photographs
        self.groups = []
        for _, group in itertools.groupby(samples, lambda s: s.protocols):
            alike = list(group)
            self.groups += [alike[i : i + batch_size] for i in range(0, len(alike), batch_size)]

    def __len__(self) -> int:
        return len(self.groups)

    def __getitem__(self, index: int) -> Batch:
        return self.photographs.batch(self.groups[index])


class StepSampler(DistributedSampler):
    """Sampler of the steps of one epoch, counted from the beginning of the run.

    It is a ``DistributedSampler`` because, with several processes, Lightning would replace any other
    sampler; the datasets themselves divide samples among processes.

    Args:
        dataset: dataset with the length of the epoch.
        first_step: called at the start of the epoch; returns its first step.
    """

    def __init__(self, dataset: Dataset, first_step: Callable[[], int]) -> None:
        super().__init__(dataset, num_replicas=1, rank=0, shuffle=False)
        self.first_step = first_step

    def __iter__(self) -> Iterator[int]:
        first = self.first_step()
        return iter(range(first, first + len(self.dataset)))

    def __len__(self) -> int:
        return len(self.dataset)


def choose_workers(batches: float, processes: int, on_gpu: bool, cores: int | None = None) -> int:
    """Choose the number of workers for ``data.workers=auto``.

    There are none for few batches, and none on a CPU: the model needs the cores, and reading a batch
    from packed files is faster than its transfer from another process. With a GPU, each process has one
    worker per core that it can use, except its own core, but at least 1 and at most 8.

    Args:
        batches: number of batches to load; infinite if unknown.
        processes: number of processes on this machine that load batches, such as one per GPU.
        on_gpu: whether batches are for a GPU.
        cores: number of cores of this machine; None: those that this process may use.

    Returns:
        Number of workers of each process.
    """
    if not on_gpu or batches < _FEW:
        return 0
    spare = (cores or allowed_cores()) // processes - 1
    return min(max(spare, 1), _MOST)


def make_loader(batches: Dataset, workers: int, **options: Any) -> DataLoader:
    """Build a loader for a dataset whose items are whole batches.

    Args:
        workers: number of worker processes; 0: none.
        options: further options of ``DataLoader``, such as a sampler.
    """
    use_known_start_method()
    with warnings.catch_warnings():
        # Each loader would warn of more workers than cores, although these were configured.
        warnings.filterwarnings("ignore", "This DataLoader will create")
        return DataLoader(
            batches,
            batch_size=None,
            num_workers=workers,
            persistent_workers=workers > 0,
            pin_memory=torch.cuda.is_available(),
            worker_init_fn=_ignore_signals,
            **options,
        )


def _ignore_signals(number: int) -> None:
    """Ignore signals in a worker. Ctrl-C reaches all processes of a terminal, and the signals that SLURM
    sends before a job's end reach all of the job; only the training process handles them, and ends its
    workers."""
    for each in (signal.SIGINT, signal.SIGUSR1, signal.SIGUSR2):
        signal.signal(each, signal.SIG_IGN)
