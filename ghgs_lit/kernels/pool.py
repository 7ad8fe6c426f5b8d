"""Work in parts, and a thread pool in each process for kernels, which run without the interpreter lock."""

import os
import threading
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache, partial

import torch
from torch import Tensor, nn


def at_once(device: torch.device, cpu: int, gpu: int) -> int:
    """How much is worked on at once: a CPU wants parts as large as its cache, a GPU few calls. ``device``:
    where the work is done. ``cpu``, ``gpu``: the limits."""
    return cpu if device.type == "cpu" else gpu


def even_parts(count: int, most: int) -> list[slice]:
    """Slices of at most ``most`` of ``count`` rows, of equal size (a small last part would be slow)."""
    parts = max(1, -(-count // max(1, most)))
    return [slice(count * i // parts, count * (i + 1) // parts) for i in range(parts)]


# Number of splats or entries that justifies one more thread: about a millisecond of work.
GRAIN = 8192

_lock = threading.Lock()
_pool: ThreadPoolExecutor | None = None
_owner: tuple[int, int] | None = None


def _reset_lock() -> None:
    """A forked child may inherit a lock held by a thread that exists only in its parent."""
    global _lock
    _lock = threading.Lock()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_reset_lock)


def _workers(count: int) -> ThreadPoolExecutor:
    """The pool of this process; a new one after a fork or a change of the number of threads."""
    global _pool, _owner
    with _lock:
        if _owner != (os.getpid(), count):
            _pool = ThreadPoolExecutor(count, thread_name_prefix="ghgs")
            _owner = (os.getpid(), count)
        return _pool


def is_supported(*tensors: Tensor) -> bool:
    """Whether kernels in single precision, which see tensors as NumPy arrays, can work on these."""
    return all(x.device.type == "cpu" and x.dtype == torch.float32 for x in tensors)


def have_values(*tensors: Tensor) -> bool:
    """Whether NumPy can read these; it cannot read PyTorch's FakeTensors."""
    return all(type(x) in (Tensor, nn.Parameter) for x in tensors)


@cache
def features() -> set[str]:
    """LLVM's names of the processor features that kernels may use; see ``processor_features``."""
    from ghgs_lit.kernels.compile import processor_features  # here: it loads a compiler

    return processor_features()


def multiplies(*tensors: Tensor) -> bool:
    """Whether kernels compute products of these, and faster than PyTorch: in single precision."""
    readable = is_supported(*tensors) and have_values(*tensors)
    return readable and not torch.is_autocast_enabled("cpu") and features() >= {"avx2", "fma"}


def run_rows(
    kernel: Callable, arguments: Sequence, ranges: Iterable[Sequence[int]], most: int, work: int
) -> None:
    """:func:`run` of ``kernel(*arguments, *numbers, first, last)`` for parts of at most ``most`` rows of each
    of ``ranges``, which are ``(*numbers, first, last)``."""
    tasks = [
        partial(kernel, *arguments, *numbers, first + part.start, first + part.stop)
        for *numbers, first, last in ranges
        for part in even_parts(last - first, most)
        if last > first
    ]
    run(tasks, work)


def run(tasks: list, work: int) -> None:
    """Call every task, on at most ``torch.get_num_threads()`` threads including the caller's. ``tasks``:
    functions without arguments. ``work``: number of splats or entries that all tasks process; small work uses
    no extra thread."""
    helpers = min(torch.get_num_threads(), len(tasks), 1 + work // GRAIN) - 1
    queue = deque(tasks)

    def drain() -> None:
        while True:
            try:
                task = queue.popleft()
            except IndexError:
                return
            task()

    futures = [_workers(torch.get_num_threads() - 1).submit(drain) for _ in range(helpers)]
    drain()
    for future in futures:
        # A helper that has not started has nothing left to do, and waiting for it could block.
        if not future.cancel():
            future.result()
