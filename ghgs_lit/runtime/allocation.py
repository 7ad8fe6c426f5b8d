"""Memory of this process: its size, when the C library returns it, when Python collects garbage."""

import contextlib
import ctypes
import functools
import gc
import os
import resource
import sys
from pathlib import Path

#: Parameters of glibc's ``mallopt``, and their largest value.
_TRIM_THRESHOLD = -1
_MMAP_THRESHOLD = -3
_MOST = 2**31 - 1
#: Linux's counters of this process, and the file that resets the peak.
_STATUS = Path("/proc/self/status")
_CLEAR = Path("/proc/self/clear_refs")


def resident_bytes(field: str = "VmRSS") -> int:
    """Memory of this process in bytes.

    Args:
        field: ``VmRSS`` (now) or ``VmHWM`` (peak since :func:`forget_peak`); except on Linux both
            are the peak since its start.
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
    """Reset the peak to the present memory, if the system can."""
    with contextlib.suppress(OSError):
        _CLEAR.write_text("5")


def return_free_memory() -> None:
    """Return free memory of the C library to the system, if possible, so that it is not counted."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)


def keep_freed_memory() -> bool:
    """Make glibc keep freed memory for reuse.

    By default glibc returns every large block to the system, which clears its pages at the next
    use: a small model spends a tenth of its forward pass or more on that. ``malloc_trim`` still
    returns the memory. Limits set by the user stay.

    Returns:
        Whether that succeeded.
    """
    if any(name.startswith("MALLOC_") or name == "GLIBC_TUNABLES" for name in os.environ):
        return False
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if os.name == "posix" else None
    if mallopt is None:  # not glibc
        return False
    return all(mallopt(name, _MOST) == 1 for name in (_MMAP_THRESHOLD, _TRIM_THRESHOLD))


#: Asking the collector whether it did so counts all frozen objects, half a million, in 0.04 s.
_freeze_once = functools.cache(gc.freeze)


def collect_garbage_again() -> None:
    """Turn the collector on again after ``gc.disable()``, and exclude the imported objects from it.
    They are frozen once in a process: at a later call there are objects that may become garbage."""
    if not gc.isenabled():
        _freeze_once()
        gc.enable()
