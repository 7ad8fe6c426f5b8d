"""Processes of a training: their number, the rank of this one, its SLURM job, and the signals that stop
it (exit code 128 + signal number)."""

import contextlib
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from types import FrameType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ghgs_lit.training.trainer import TrainerOptions

#: Environment variables with the rank of a process; they may be left over in shells of batch jobs and of
#: crashed launchers.
_RANKS = ("RANK", "LOCAL_RANK")


def process_count(trainer: "TrainerOptions") -> int:
    """Number of processes that train, at least 1: one per device of each machine."""
    devices = trainer.devices
    if isinstance(devices, tuple):
        count = len(devices)
    elif devices not in ("auto", -1):
        count = devices
    elif trainer.accelerator == "cpu":
        count = 1
    else:
        import torch  # here: planning a sweep does not need PyTorch

        count = max(1, torch.cuda.device_count())
    return count * trainer.num_nodes


def settle_rank(trainer: "TrainerOptions") -> int:
    """Determine the rank of this process within its training.

    Environment variables count only where a launcher has started several processes; otherwise they are
    left over and are removed.

    Returns:
        The rank; 0 for the first or only process.
    """
    from lightning.pytorch.utilities import rank_zero_only  # here: it imports PyTorch

    if process_count(trainer) > 1 and (in_srun() or "WORLD_SIZE" in os.environ):
        return rank_zero_only.rank
    for name in _RANKS:
        os.environ.pop(name, None)
    rank_zero_only.rank = 0
    return 0


def in_srun() -> bool:
    """Whether ``srun`` started this process as a task of a batch job."""
    starters = ("SLURM_STEP_ID", "SRUN_DEBUG")
    is_task = "SLURM_NTASKS" in os.environ and any(name in os.environ for name in starters)
    return is_task and os.environ.get("SLURM_JOB_NAME") not in ("bash", "interactive")


def slurm_job() -> str | None:
    """ID of the SLURM job, which is kept when the job is requeued; None outside SLURM."""
    array = os.environ.get("SLURM_ARRAY_JOB_ID")
    task = os.environ.get("SLURM_ARRAY_TASK_ID")
    return f"{array}_{task}" if array and task else os.environ.get("SLURM_JOB_ID")


def is_queued_again() -> bool:
    """Whether SLURM has requeued the job of this process."""
    return os.environ.get("SLURM_RESTART_COUNT", "0") != "0"


def queue_again(number: int) -> bool:
    """Requeue the SLURM job of an ``srun`` task that was stopped at the end of its time limit.

    Args:
        number: Signal that stopped the task; only SIGUSR1 announces the end of a job's time.

    Returns:
        Whether the job was requeued.
    """
    job = slurm_job()
    if number != signal.SIGUSR1 or job is None or not in_srun():
        return False
    try:
        return subprocess.run(["scontrol", "requeue", job], check=False).returncode == 0
    except OSError:
        return False


#: Signals that ``sbatch --signal`` sends before the end of a job's time.
ANNOUNCED = (signal.SIGUSR1, signal.SIGUSR2)
STOP = (signal.SIGINT, signal.SIGTERM, *ANNOUNCED)


class Interrupted(SystemExit):
    """A signal stopped this process; the exit code is 128 + the signal number.

    Derived from ``SystemExit`` because Hydra treats any ``Exception`` as one failed job and starts the
    next.

    Args:
        number: Number of the signal.

    Attributes:
        explained: Whether the line on how to continue has been printed.
    """

    def __init__(self, number: int) -> None:
        super().__init__(128 + number)
        self.number = number
        self.explained = False


class _Handler:
    """Signal handler that calls ``act(number)`` only in the process that created it, not in forked
    workers."""

    def __init__(self, act: Callable[[int], Any]) -> None:
        self.act = act
        self.process = os.getpid()

    def __call__(self, number: int, frame: FrameType | None) -> None:
        if os.getpid() == self.process:
            self.act(number)
        elif number == signal.SIGTERM:  # sent by a parent process to terminate its workers
            signal.signal(number, signal.SIG_DFL)
            os.kill(os.getpid(), number)


#: Interruptions received in the current outermost :func:`interruptible`.
_received: list[Interrupted] = []


def interrupt(number: int) -> None:
    """Raise :class:`Interrupted` for a signal number.

    Raises:
        Interrupted: Always.
    """
    _received.append(Interrupted(number))
    raise _received[-1]


def stop_if_interrupted() -> None:
    """Raise an interruption again if it was lost.

    A signal may arrive while a library restores state in a ``finally`` block: an error raised there hides
    the interruption, and code that catches this error drops both.

    Raises:
        Interrupted: A signal has arrived in the current :func:`interruptible`.
    """
    if _received:
        raise _received[-1]


def handlers() -> dict[int, Any]:
    """Current handlers of the signals :data:`STOP`, except those not installed from Python."""
    present = {number: signal.getsignal(number) for number in STOP}
    return {number: handler for number, handler in present.items() if handler is not None}


def handle(act: Callable[[int], Any], before: Mapping[int, Any]) -> None:
    """Install a signal handler, in the main thread only.

    Handlers of other code stay unless their signal announces the end of a job's time (:data:`ANNOUNCED`):
    under submitit, for example, SIGTERM does not end a job.

    Args:
        act: Called with the signal number.
        before: Previous handlers by signal, see :func:`handlers`.
    """
    if threading.current_thread() is not threading.main_thread():
        return  # signals belong to the main thread
    for number, handler in before.items():
        is_lent = number in ANNOUNCED and callable(handler)
        signal.signal(number, _Handler(act) if is_lent or _is_free(handler) else handler)


def _is_free(handler: Any) -> bool:
    return handler in (signal.SIG_DFL, signal.default_int_handler) or isinstance(handler, _Handler)


@contextlib.contextmanager
def interruptible() -> Iterator[None]:
    """Raise :class:`Interrupted` on the signals :data:`STOP` unless other code handles them.

    An interruption that was lost (:func:`stop_if_interrupted`) is raised again at the end of the block.
    Other code's handlers of announced ends, such as submitit's, which requeues the job, are called at the
    end of the block.
    """
    before = handlers()
    is_outermost = not any(isinstance(handler, _Handler) for handler in before.values())
    handle(interrupt, before)
    try:
        stop_if_interrupted()
        yield
        stop_if_interrupted()
    except Exception:
        stop_if_interrupted()
        raise
    finally:
        if threading.current_thread() is threading.main_thread():
            for number, handler in before.items():
                signal.signal(number, handler)
        if is_outermost and _received:
            number = _received.pop().number
            _received.clear()
            _pass_on(number, before[number])


def _pass_on(number: int, handler: Any) -> None:
    """Call another library's handler of a signal, if there is one."""
    if not _is_free(handler):
        # The command that requeues a job may be killed together with the job before it returns.
        with contextlib.suppress(subprocess.CalledProcessError):
            handler(number, None)


def print_how_to_go_on(stop: Interrupted, what: str, where: str) -> None:
    """Requeue the SLURM job if its time is up, print how what was stopped continues, and mark the
    interruption as explained.

    Args:
        stop: The interruption.
        what: What was stopped.
        where: Override with which the same command continues it.
    """
    stop.explained = True
    how = f"to go on, the same command with {where}"
    if queue_again(stop.number):
        how = "SLURM queues its job again"
    print(f"ghgs: {what} was interrupted ({signal.Signals(stop.number).name}); {how}", file=sys.stderr)
