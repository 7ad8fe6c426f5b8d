"""Processes that load batches: how many there are, how they start and how they end."""

import multiprocessing
import signal
import warnings
from typing import Any

import torch
from torch.utils.data import DataLoader, Dataset

from ghgs_lit.runtime.cores import allowed_cores, use_known_start_method

#: Batches below which processes take longer to start than they save: forked ones,
#: and those that import.
_FEW_FORKED = 32
_FEW_STARTED = 256
#: More processes than this wait for the disk.
_MOST = 8


def automatic_workers(batches: float, processes: int, on_gpu: bool, cores: int | None = None) -> int:
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


def loader_of(batches: Dataset, workers: int, **options: Any) -> DataLoader:
    """A loader whose items are whole batches.

    Args:
        batches: the batches.
        workers: number of loading processes; 0: none.
        options: of the ``DataLoader``, such as its sampler.
    """
    use_known_start_method()
    with warnings.catch_warnings():
        # Each loader would warn of more workers than cores, which were asked for.
        warnings.filterwarnings("ignore", "This DataLoader will create")
        return DataLoader(
            batches,
            batch_size=None,
            num_workers=workers,
            persistent_workers=workers > 0,
            pin_memory=torch.cuda.is_available(),
            worker_init_fn=_leave_interrupts,
            **options,
        )


def _leave_interrupts(number: int) -> None:
    """Ctrl-C reaches every process of a terminal, and what SLURM sends before a job's end every one of
    the job; the one that trains ends the others."""
    for each in (signal.SIGINT, signal.SIGUSR1, signal.SIGUSR2):
        signal.signal(each, signal.SIG_IGN)
