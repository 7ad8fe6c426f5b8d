"""The processes of a training: how many there are, which one this is, the SLURM job that they are in,
and the signals that stop them (exit code 128 + their number)."""

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
    """Rank of this process among those of its training. Variables of the environment count only where
    a launcher has started several processes; elsewhere they are left over, and are removed.

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
    """Name of all processes that were started together: the job's step or torchrun's name, and how
    often it was started again; None: there is no launcher."""
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
    """Queue the SLURM job of a task again that was stopped because its time is up.

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


#: Signals that ``sbatch --signal`` sends before the end of a job's time.
ANNOUNCED = (signal.SIGUSR1, signal.SIGUSR2)
STOP = (signal.SIGINT, signal.SIGTERM, *ANNOUNCED)


class Interrupted(SystemExit):
    """A signal has stopped this process; the exit code is 128 + its number.

    A ``SystemExit``, because Hydra takes any ``Exception`` for one failed job and
    starts the next one.

    Args:
        number: of the signal.

    Attributes:
        explained: whether the line that says how to go on was printed.
    """

    def __init__(self, number: int) -> None:
        super().__init__(128 + number)
        self.number = number
        self.explained = False


class _Handler:
    """Signal handler that calls ``act(number)`` only in the process that made it,
    not in forked workers."""

    def __init__(self, act: Callable[[int], Any]) -> None:
        self.act = act
        self.process = os.getpid()

    def __call__(self, number: int, frame: FrameType | None) -> None:
        if os.getpid() == self.process:
            self.act(number)
        elif number == signal.SIGTERM:  # sent by a parent to end its workers
            signal.signal(number, signal.SIG_DFL)
            os.kill(os.getpid(), number)


#: Interruptions of the present outermost :func:`interruptible`.
_received: list[Interrupted] = []


def interrupt(number: int) -> None:
    """Raise :class:`Interrupted`.

    Args:
        number: Of the signal.

    Raises:
        Interrupted: Always.
    """
    _received.append(Interrupted(number))
    raise _received[-1]


def stop_if_interrupted() -> None:
    """Raise an interruption again that was lost.

    A signal may arrive while a library restores something in a ``finally``: what it raises then
    hides the interruption, and whoever expects such an error drops both.

    Raises:
        Interrupted: A signal has arrived in the present :func:`interruptible`.
    """
    if _received:
        raise _received[-1]


def handlers() -> dict[int, Any]:
    """Present handlers of these signals, without those that were not set from Python."""
    present = {number: signal.getsignal(number) for number in STOP}
    return {number: handler for number, handler in present.items() if handler is not None}


def handle(act: Callable[[int], Any], before: Mapping[int, Any]) -> None:
    """Let a function handle signals, except those that others handle and that do not announce an
    end: under submitit SIGTERM does not end a job.

    Args:
        act: Gets the number of the signal.
        before: Handlers by signal, as of :func:`handlers`.
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
    """Raise :class:`Interrupted` on the signals :data:`STOP` unless others handle them; where it is
    lost (:func:`stop_if_interrupted`), once more at the end of the block. Handlers of others for an
    announced end, as submitit's, which queues the job again, are called at the end of the block."""
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
    """Call the handler that others have set for a signal, if any."""
    if not _is_free(handler):
        # The program that queues a job again may be ended with it before it returns.
        with contextlib.suppress(subprocess.CalledProcessError):
            handler(number, None)


def print_how_to_go_on(stop: Interrupted, what: str, how: str, is_queued: bool) -> None:
    """Print to stderr what was stopped, and how it goes on.

    Args:
        stop: The interruption; it counts as explained from then on.
        what: What was stopped.
        how: Which command goes on.
        is_queued: Whether SLURM will run it again.
    """
    stop.explained = True
    name = signal.Signals(stop.number).name
    how = "SLURM queues its job again" if is_queued else how
    print(f"ghgs: {what} was interrupted ({name}); {how}", file=sys.stderr)
