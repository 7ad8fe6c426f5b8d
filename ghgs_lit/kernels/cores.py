"""The cores that this process may use."""

import os
from pathlib import Path


def allowed_cores(cgroups: Path = Path("/sys/fs/cgroup")) -> int:
    """The number of cores by affinity and by a container's quota (control groups of version 2 or 1)."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    for files in (("cpu.max",), ("cpu/cpu.cfs_quota_us", "cpu/cpu.cfs_period_us")):
        try:
            quota, period = " ".join((cgroups / name).read_text() for name in files).split()
            share = int(quota) / int(period)
        except (OSError, ValueError, ZeroDivisionError):
            continue  # none, or "max"
        cores = min(cores, max(int(share), 1)) if share > 0 else cores
    return cores
