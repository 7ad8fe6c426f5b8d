"""Division of work into parts, and a thread pool for kernels,
which run without the interpreter lock."""

import os
import threading
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache, partial

import torch
from torch import Tensor, nn


def at_once(device: torch.device, cpu: int, gpu: int) -> int:
    """The limit for ``device``: a CPU needs parts that fit its cache, a GPU few calls.

    Args:
        device: where the work is done.
        cpu: limit for a CPU.
        gpu: limit for any other device.
    """
    return cpu if device.type == "cpu" else gpu


def even_parts(count: int, most: int) -> list[slice]:
    """Slices of equal size: a small last part would be slow.

    Args:
        count: number of rows.
        most: of rows in a slice.

    Returns:
        Slices that cover ``range(count)``; an empty one if ``count`` is 0.
    """
    parts = max(1, -(-count // max(1, most)))
    return [slice(count * i // parts, count * (i + 1) // parts) for i in range(parts)]


def in_parts(function: Callable[[slice], Tensor], count: int, most: int) -> Tensor:
    """A function of all rows, computed for a part of them at a time.

    Args:
        function: rows to values [..., m, c].
        count: number of all rows.
        most: of rows in a part; with a gradient all.

    Returns:
        Values [..., count, c].
    """
    parts = even_parts(count, most)
    if len(parts) == 1:
        return function(slice(None))
    result = None
    for rows in parts:
        part = function(rows)
        if result is None:  # filled, since small results between freed parts would fragment the memory
            result = part.new_empty(*part.shape[:-2], count, part.shape[-1])
        result[..., rows, :] = part
    return result


# Splats or entries that justify one more thread: about a millisecond of work.
GRAIN = 8192

_lock = threading.Lock()
_pool: ThreadPoolExecutor | None = None
_owner: tuple[int, int] | None = None


def _reset_lock() -> None:
    """Replace the lock: a forked child may inherit it held by a thread that exists only in
    its parent."""
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


def have_values(*tensors: Tensor) -> bool:
    """Whether NumPy can read these, unlike PyTorch's FakeTensors."""
    return all(type(x) in (Tensor, nn.Parameter) for x in tensors)


@cache
def features() -> set[str]:
    """Processor features that kernels may use;
    see :func:`ghgs_lit.ops.compile.processor_features`."""
    from ghgs_lit.ops.compile import processor_features  # here: it loads a compiler

    return processor_features()


def multiplies(*tensors: Tensor) -> bool:
    """Whether kernels compute products of these faster than PyTorch: float32 on a CPU with AVX2."""
    supported = all(x.device.type == "cpu" and x.dtype == torch.float32 for x in tensors)
    return (
        supported
        and have_values(*tensors)
        and not torch.is_autocast_enabled("cpu")
        and features() >= {"avx2", "fma"}
    )


def run_rows(
    kernel: Callable, arguments: Sequence, ranges: Iterable[Sequence[int]], most: int, work: int
) -> None:
    """:func:`run` a kernel for parts of ranges of rows.

    Args:
        kernel: called as ``kernel(*arguments, *numbers, first, last)``.
        arguments: of all calls.
        ranges: each ``(*numbers, first, last)``.
        most: rows of a call.
        work: splats or entries of all ranges; little work uses no extra thread.
    """
    tasks = []
    for *numbers, first, last in ranges:
        parts = even_parts(last - first, most) if last > first else []
        for part in parts:
            tasks.append(partial(kernel, *arguments, *numbers, first + part.start, first + part.stop))
    run(tasks, work)


def run(tasks: list, work: int) -> None:
    """Call every task on at most ``torch.get_num_threads()`` threads, the caller's included.

    Args:
        tasks: functions without arguments.
        work: splats or entries of all tasks; little work uses no extra thread.
    """
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
        # A helper that has not started is no longer needed, and waiting for it could block.
        if not future.cancel():
            future.result()
