"""Batches from samples, and the processes that load them; an item of the torch datasets here is a
whole :class:`Batch`."""

import itertools
import multiprocessing
import signal
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch.utils.data import DataLoader, Dataset, DistributedSampler

from ghgs_lit.data.augmentation import Augmentation, Size
from ghgs_lit.data.reader import Photographs
from ghgs_lit.data.sampling import Sample, TrainingSampler
from ghgs_lit.runtime.cores import allowed_cores, use_known_start_method
from ghgs_lit.types import Batch

#: Batches below which processes take longer to start than they save: forked ones,
#: and those that import.
_FEW_FORKED = 32
_FEW_STARTED = 256
#: More processes than this wait for the disk.
_MOST = 8


@dataclass(frozen=True)
class TrainingBatches(Dataset):
    """Item ``step`` is the batch of process ``rank`` of ``world`` at that step of the run.

    Args:
        photographs: of the subjects.
        sampler: draws samples.
        augmentation: varies batches.
        length: steps of an epoch.
        depths: whether depth maps of the inputs are read.
        rank: number of this process.
        world: number of processes.
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

    def sizes(self, step: int) -> tuple[Size, Size]:
        """(height, width) of the inputs and of the targets at a step."""
        fixed = self.photographs.size, self.photographs.target_size
        step_of_class = step // self.sampler.class_steps
        return self.augmentation.draw_sizes(*fixed, self.sampler.seed, step_of_class)

    def __getitem__(self, step: int) -> Batch:
        samples = self.sampler.batch(step, self.rank, self.world)
        batch = self.photographs.batch(samples, self.sizes(step), self.depths, target_depths=False)
        indices = self.sampler.indices(step, self.rank, self.world)
        return self.augmentation.imperfect(batch, self.sampler.seed, step, indices)


class EvaluationBatches(Dataset):
    """Fixed samples; an item has consecutive ones with equal target protocols.

    Args:
        photographs: of the subjects.
        samples: the samples.
        batch_size: largest number of samples in an item.
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
    """Steps of one epoch, counted from the beginning of the run.

    A ``DistributedSampler``, because with several processes Lightning replaces any other sampler by
    its own; the datasets divide samples among processes themselves.

    Args:
        dataset: its length is that of the epoch.
        first_step: is called when the epoch starts, and gives its first step.
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
    """The number of loading processes of ``data.workers=auto``.

    None for a few batches, and none on a CPU: the model needs the cores itself, and a batch takes
    longer to come from another process than to be read from packed files. Beside a GPU as many as
    there are cores for each process, less its own, at least 1 and at most 8.

    Args:
        batches: number of batches that are loaded; infinite where it is not known.
        processes: processes of this machine that each load batches, such as one for each GPU.
        on_gpu: whether batches are for a GPU.
        cores: cores of this machine; None: those that this process may use.

    Returns:
        Number of loading processes of each process.
    """
    use_known_start_method()
    few = _FEW_FORKED if multiprocessing.get_start_method() == "fork" else _FEW_STARTED
    if not on_gpu or batches < few:
        return 0
    spare = (cores or allowed_cores()) // processes - 1
    return min(max(spare, 1), _MOST)


def make_loader(batches: Dataset, workers: int, **options: Any) -> DataLoader:
    """A loader whose items are whole batches.

    Args:
        batches: the batches.
        workers: number of loading processes; 0: none.
        options: of the ``DataLoader``, such as its sampler.
    """
    use_known_start_method()
    with warnings.catch_warnings():
        # Each loader would warn of more workers than cores, which were configured.
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
    """Ctrl-C reaches every process of a terminal, and what SLURM sends before a job's end every one of
    the job; the one that trains ends the others."""
    for each in (signal.SIGINT, signal.SIGUSR1, signal.SIGUSR2):
        signal.signal(each, signal.SIG_IGN)
