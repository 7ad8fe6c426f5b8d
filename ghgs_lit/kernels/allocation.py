"""How much memory this process has, how the C library gives it back, when Python looks for garbage."""

import contextlib
import ctypes
import gc
import os
import resource
import sys
from pathlib import Path

#: Parameters of glibc's ``mallopt``, and the largest value of one.
_TRIM_THRESHOLD, _MMAP_THRESHOLD, _MOST = -1, -3, 2**31 - 1
#: Linux's counters of this process, and what resets the peak.
_STATUS, _CLEAR = Path("/proc/self/status"), Path("/proc/self/clear_refs")


def resident_bytes(field: str = "VmRSS") -> int:
    """``VmRSS`` (memory now) or ``VmHWM`` (peak since :func:`forget_peak`) of this process; both are the
    highest memory so far on other systems than Linux."""
    if _STATUS.exists():
        line = next(line for line in _STATUS.read_text().splitlines() if line.startswith(field + ":"))
        return int(line.split()[1]) * 1024
    unit = 1 if sys.platform == "darwin" else 1024
    return unit * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def can_forget_peak() -> bool:
    """Whether :func:`forget_peak` does anything: on Linux, unless a container forbids it."""
    return os.access(_CLEAR, os.W_OK)


def forget_peak() -> None:
    """Let the peak begin afresh with the memory that is held now, where the system can."""
    with contextlib.suppress(OSError):
        _CLEAR.write_text("5")


def return_free_memory() -> None:
    """Give free memory that the C library keeps back to the system, where it can: it must not count."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)


def keep_freed_memory() -> bool:
    """Let this process use the memory of freed tensors again; returns whether the C library could be asked.

    By default glibc gives every large block back to the system, which clears its pages when they are used the
    next time: a small model spends a tenth of its forward pass or more on that. ``malloc_trim`` still gives
    the memory back. Where the user's environment sets these limits, they stay.
    """
    if any(name.startswith("MALLOC_") or name == "GLIBC_TUNABLES" for name in os.environ):
        return False
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if os.name == "posix" else None
    if mallopt is None:  # not glibc
        return False
    return all(mallopt(name, _MOST) == 1 for name in (_MMAP_THRESHOLD, _TRIM_THRESHOLD))


def collect_garbage_again() -> None:
    """Turn the collector on again after ``gc.disable()``; it leaves alone, at exit too, what was imported.

    That once in a process: a later call finds objects that may become garbage.
    """
    if not gc.isenabled():
        if not gc.get_freeze_count():
            gc.freeze()
        gc.enable()
