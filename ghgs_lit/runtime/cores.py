"""CPU cores that this process may use, how its threads wait, and how it starts other processes."""

import fcntl
import multiprocessing
import os
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import IO

#: Number of spins of a waiting libgomp thread before it sleeps: 0.2 ms.
_TURNS = "20000"
#: Parts of command-line arguments that start several processes.
_SEVERAL = ("launcher=", "sweep=", "ddp", "devices=")
#: Handle of the locked file while this process may spin.
_spins: list[IO[str]] = []


def spin_if_alone(arguments: Sequence[str], running: Path = Path("/proc/loadavg")) -> None:
    """Let OpenMP threads spin before they sleep if no other process is running; call before importing
    PyTorch.

    On an idle virtual machine a sleeping thread wakes up late: steps of ``experiment=demo`` take 0.75 s
    instead of 0.29 s. Two spinning processes on the same cores take seven times as long, so only one per
    machine may spin.

    Args:
        arguments: Command-line arguments; threads sleep if one of them starts several processes.
        running: File of Linux with the numbers of running and of all threads.
    """
    try:
        alone = running.read_text().split()[3].startswith("1/")
        handle = open(Path(tempfile.gettempdir()) / f"ghgs-spins-{os.getuid()}", "a")  # noqa: SIM115
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except (OSError, IndexError):
        return
    command = " ".join(arguments)
    if alone and not any(word in command for word in _SEVERAL):
        _spins.append(handle)
        os.environ["GOMP_SPINCOUNT"] = _TURNS


def let_children_sleep() -> None:
    """Keep child processes started from now on from spinning; see :func:`spin_if_alone`."""
    if _spins:
        os.environ.pop("GOMP_SPINCOUNT", None)


def use_known_start_method() -> None:
    """Use a start method of :mod:`multiprocessing` that data loaders support.

    joblib's workers set another one, with which data loaders cannot start.
    """
    known = multiprocessing.get_all_start_methods()  # the platform's default comes first
    if multiprocessing.get_start_method() not in known:
        multiprocessing.set_start_method(known[0], force=True)


def allowed_cores(cgroups: Path = Path("/sys/fs/cgroup")) -> int:
    """Number of cores permitted by CPU affinity and by a container's quota (cgroups version 2 or 1), at
    least 1.

    Args:
        cgroups: Folder of the control groups' files.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    for files in (("cpu.max",), ("cpu/cpu.cfs_quota_us", "cpu/cpu.cfs_period_us")):
        try:
            quota, period = " ".join((cgroups / name).read_text() for name in files).split()
            share = int(quota) / int(period)
        except (OSError, ValueError, ZeroDivisionError):
            continue  # no quota, or "max"
        cores = min(cores, max(int(share), 1)) if share > 0 else cores
    return cores
