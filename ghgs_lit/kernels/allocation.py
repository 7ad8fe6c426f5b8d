"""How the C library gives memory back, and when Python looks for garbage."""

import ctypes
import gc
import os

#: Parameters of glibc's ``mallopt``, and the largest value of one.
_TRIM_THRESHOLD, _MMAP_THRESHOLD, _MOST = -1, -3, 2**31 - 1


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
