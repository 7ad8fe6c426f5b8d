"""The processes of a training: how many there are, which one this is,
and the SLURM job that they are in."""

import os
import signal
import subprocess
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ghgs_lit.training.trainer import TrainerOptions

#: Variables that number the processes of a training;
#: shells of jobs and of crashed launchers keep them.
_RANKS = ("RANK", "LOCAL_RANK")


def process_count(trainer: "TrainerOptions") -> int:
    """Number of processes that train: one for each device of each machine.

    Args:
        trainer: Its options.

    Returns:
        At least 1.
    """
    devices = trainer.devices
    if isinstance(devices, tuple):
        count = len(devices)
    elif devices in ("auto", -1):
        count = _device_count(trainer.accelerator)
    else:
        count = devices
    return count * trainer.num_nodes


def _device_count(accelerator: str) -> int:
    if accelerator == "cpu":
        return 1
    import torch  # here: plans of sweeps need none

    return max(1, torch.cuda.device_count())


def settle_rank(trainer: "TrainerOptions") -> int:
    """Rank of this process among those of its training. What the environment says counts only where
    a launcher has started several processes; elsewhere it is left over, and is forgotten.

    Args:
        trainer: Its options.

    Returns:
        The rank; 0: the first, or the only one.
    """
    from lightning.pytorch.utilities import rank_zero_only  # here: it imports PyTorch

    if process_count(trainer) > 1 and (in_srun() or "WORLD_SIZE" in os.environ):
        return rank_zero_only.rank
    for name in _RANKS:
        os.environ.pop(name, None)
    rank_zero_only.rank = 0
    return 0


def in_srun() -> bool:
    """Whether ``srun`` has started this process as a task of a batch job."""
    starters = ("SLURM_STEP_ID", "SRUN_DEBUG")
    is_task = "SLURM_NTASKS" in os.environ and any(name in os.environ for name in starters)
    return is_task and os.environ.get("SLURM_JOB_NAME") not in ("bash", "interactive")


def launch() -> str | None:
    """What the processes share that were started together: the job's step or torchrun's name, and
    how often it was started again; None: no launcher says."""
    names = {
        "TORCHELASTIC_RUN_ID": ("TORCHELASTIC_RUN_ID", "TORCHELASTIC_RESTART_COUNT"),
        "SLURM_STEP_ID": ("SLURM_JOB_ID", "SLURM_STEP_ID", "SLURM_RESTART_COUNT"),
    }
    for first, all_of_them in names.items():
        if first in os.environ:
            return ".".join(os.environ.get(name, "0") for name in all_of_them)
    return None


def slurm_job() -> str | None:
    """Name of the SLURM job, which it keeps when it is queued again; None: outside of SLURM."""
    array = os.environ.get("SLURM_ARRAY_JOB_ID")
    task = os.environ.get("SLURM_ARRAY_TASK_ID")
    return f"{array}_{task}" if array and task else os.environ.get("SLURM_JOB_ID")


def is_queued_again() -> bool:
    """Whether SLURM has queued the job of this process again, after it had run."""
    return os.environ.get("SLURM_RESTART_COUNT", "0") != "0"


def queue_again(number: int) -> bool:
    """Let SLURM queue the job of a task again that was stopped because its time is up.

    Args:
        number: Signal that stopped it; SIGUSR1 announces the end of a job's time.

    Returns:
        Whether the job is queued again.
    """
    job = slurm_job()
    if number != signal.SIGUSR1 or job is None or not in_srun():
        return False
    try:
        return subprocess.run(["scontrol", "requeue", job], check=False).returncode == 0
    except OSError:
        return False
