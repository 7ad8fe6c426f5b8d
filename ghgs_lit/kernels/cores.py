"""The cores that this process may use."""

import os
from pathlib import Path

_CGROUPS = Path("/sys/fs/cgroup")


def allowed_cores(cgroups: Path = _CGROUPS) -> int:
    """The number of cores by affinity and by the quota of a container, at least 1.

    Args:
        cgroups: where the system mounts its control groups, of version 2 or 1.
    """
    affinity = getattr(os, "sched_getaffinity", None)
    cores = len(affinity(0)) if affinity else os.cpu_count() or 1
    for quota, period in (("cpu.max", None), ("cpu/cpu.cfs_quota_us", "cpu/cpu.cfs_period_us")):
        try:
            numbers = (cgroups / quota).read_text().split()
            numbers += (cgroups / period).read_text().split() if period else []
            share = float(numbers[0]) / float(numbers[1])
        except (OSError, ValueError, IndexError, ZeroDivisionError):
            continue  # none, or "max"
        if share > 0:
            # As schedulers do: half a core is one process.
            cores = min(cores, max(int(share), 1))
    return cores
