"""Memory of this process: its size, when the C library returns it, and when Python collects garbage."""

import contextlib
import ctypes
import functools
import gc
import os
import resource
import sys
from pathlib import Path

#: Parameters of glibc's ``mallopt``, and their maximum.
_TRIM_THRESHOLD = -1
_MMAP_THRESHOLD = -3
_MOST = 2**31 - 1
#: Linux counters of this process, and the file that resets the peak.
_STATUS = Path("/proc/self/status")
_CLEAR = Path("/proc/self/clear_refs")


def resident_bytes(field: str = "VmRSS") -> int:
    """Resident memory of this process in bytes.

    Args:
        field: ``VmRSS`` (current) or ``VmHWM`` (peak since :func:`forget_peak`); on systems other than
            Linux both return the peak since the process started.
    """
    if _STATUS.exists():
        line = next(line for line in _STATUS.read_text().splitlines() if line.startswith(field + ":"))
        return int(line.split()[1]) * 1024
    unit = 1 if sys.platform == "darwin" else 1024
    return unit * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def can_forget_peak() -> bool:
    """Whether :func:`forget_peak` works: on Linux, unless a container forbids it."""
    return os.access(_CLEAR, os.W_OK)


def forget_peak() -> None:
    """Reset the peak memory to the current value, if the system allows it."""
    with contextlib.suppress(OSError):
        _CLEAR.write_text("5")


def return_free_memory() -> None:
    """Return unused memory of the C library to the system, if possible, so that it is not counted."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)


def keep_freed_memory() -> bool:
    """Make glibc keep freed memory for reuse.

    By default glibc returns every large block to the system, which clears its pages at the next use: a
    small model spends a tenth of its forward pass or more on this. ``malloc_trim`` still returns the
    memory. Limits set by the user in the environment take precedence.

    Returns:
        Whether glibc accepted the settings.
    """
    if any(name.startswith("MALLOC_") or name == "GLIBC_TUNABLES" for name in os.environ):
        return False
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if os.name == "posix" else None
    if mallopt is None:  # not glibc
        return False
    return all(mallopt(name, _MOST) == 1 for name in (_MMAP_THRESHOLD, _TRIM_THRESHOLD))


#: ``gc.get_freeze_count()`` would take 0.04 s for the half million frozen objects.
_freeze_once = functools.cache(gc.freeze)


def collect_garbage_again() -> None:
    """Re-enable the garbage collector after ``gc.disable()``, excluding all imported objects.

    Objects are frozen once per process: at a later call some of them may become garbage.
    """
    if not gc.isenabled():
        _freeze_once()
        gc.enable()
