"""The cores that this process may use, how its threads wait, and how it starts
other processes."""

import fcntl
import multiprocessing
import os
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import IO

#: Spins of a waiting thread of libgomp before it sleeps: 0.2 ms.
_TURNS = "20000"
#: Parts of command-line arguments that ask for several processes.
_SEVERAL = ("launcher=", "sweep=", "ddp", "devices=")
#: Handle of the locked file while this process is the one that spins.
_spins: list[IO[str]] = []


def spin_if_alone(arguments: Sequence[str], running: Path = Path("/proc/loadavg")) -> None:
    """Let OpenMP's threads spin before they sleep if no other process runs;
    call before importing PyTorch.

    On an idle virtual machine a sleeping thread wakes late: steps of ``experiment=demo`` take 0.75
    s instead of 0.29. Two spinning processes on the same cores take seven times as long, so only
    one per machine may.

    Args:
        arguments: of the command line; threads sleep where one starts several processes.
        running: Linux's file of the numbers of running and of all threads.
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


def children_sleep() -> None:
    """Let child processes that start from now on not spin; see :func:`spin_if_alone`."""
    if _spins:
        os.environ.pop("GOMP_SPINCOUNT", None)


def use_known_start_method() -> None:
    """Let this process start others as a fresh one does. joblib's workers have another start
    method, by which data loaders cannot start."""
    known = multiprocessing.get_all_start_methods()  # the platform's default comes first
    if multiprocessing.get_start_method() not in known:
        multiprocessing.set_start_method(known[0], force=True)


def allowed_cores(cgroups: Path = Path("/sys/fs/cgroup")) -> int:
    """Number of cores by affinity and by a container's quota (control groups of version 2 or 1).

    Args:
        cgroups: where the files of the control groups are.

    Returns:
        At least 1.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    for files in (("cpu.max",), ("cpu/cpu.cfs_quota_us", "cpu/cpu.cfs_period_us")):
        try:
            quota, period = " ".join((cgroups / name).read_text() for name in files).split()
            share = int(quota) / int(period)
        except (OSError, ValueError, ZeroDivisionError):
            continue  # none, or "max"
        cores = min(cores, max(int(share), 1)) if share > 0 else cores
    return cores
