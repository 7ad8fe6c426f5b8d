"""Division of work into parts, and a thread pool for kernels that run without the interpreter lock."""

import os
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache, partial

import torch
from torch import Tensor, nn


def at_once(device: torch.device, cpu: int, gpu: int) -> int:
    """Select the limit for ``device``: parts should fit the cache of a CPU, and be few on a GPU.

    Args:
        device: device of the computation.
        cpu: limit for a CPU.
        gpu: limit for any other device.
    """
    return cpu if device.type == "cpu" else gpu


def even_parts(count: int, most: int) -> list[slice]:
    """Divide ``range(count)`` into slices of nearly equal size, since a small last part would be slow.

    Args:
        count: number of rows.
        most: largest number of rows in a slice; less than 1 counts as 1.

    Returns:
        Slices that cover ``range(count)``; one empty slice if ``count`` is 0.
    """
    parts = max(1, -(-count // max(1, most)))
    return [slice(count * i // parts, count * (i + 1) // parts) for i in range(parts)]


def in_parts(function: Callable[[slice], Tensor], count: int, most: int) -> Tensor:
    """Compute a function of rows, one part of the rows at a time.

    Args:
        function: maps a slice of rows to values [..., m, c].
        count: number of rows.
        most: largest number of rows in a part; with a gradient, all rows.

    Returns:
        Values [..., count, c].
    """
    parts = even_parts(count, most)
    if len(parts) == 1:
        return function(slice(None))
    result = None
    for rows in parts:
        part = function(rows)
        if result is None:  # filled in place: small results between freed parts fragment the memory
            result = part.new_empty(*part.shape[:-2], count, part.shape[-1])
        result[..., rows, :] = part
    return result


# Splats or entries that justify one more thread: about a millisecond of work.
GRAIN = 8192


@cache
def _workers(process: int, count: int) -> ThreadPoolExecutor:
    """A pool of ``count`` threads; ``process`` is the calling process: a forked child needs its own."""
    return ThreadPoolExecutor(count, thread_name_prefix="ghgs")


def have_values(*tensors: Tensor) -> bool:
    """Whether all tensors have data that NumPy can read, unlike PyTorch's FakeTensors."""
    return all(type(x) in (Tensor, nn.Parameter) for x in tensors)


@cache
def features() -> set[str]:
    """Cached :func:`ghgs_lit.ops.compile.processor_features`."""
    from ghgs_lit.ops.compile import processor_features  # here: it loads a compiler

    return processor_features()


def multiplies(*tensors: Tensor) -> bool:
    """Whether kernels multiply these faster than PyTorch: float32 on a CPU with AVX2, no autocast."""
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
    """Run a kernel on ranges of rows, divided into parts; see :func:`run`.

    Args:
        kernel: called as ``kernel(*arguments, *numbers, first, last)``.
        arguments: arguments common to all calls.
        ranges: tuples ``(*numbers, first, last)``; ``last`` is excluded.
        most: largest number of rows of a call.
        work: number of splats or entries in all ranges; little work uses no extra thread.
    """
    tasks = []
    for *numbers, first, last in ranges:
        parts = even_parts(last - first, most) if last > first else []
        for part in parts:
            tasks.append(partial(kernel, *arguments, *numbers, first + part.start, first + part.stop))
    run(tasks, work)


def run(tasks: list, work: int) -> None:
    """Call all tasks on at most ``torch.get_num_threads()`` threads, the caller's included.

    Args:
        tasks: functions without arguments.
        work: number of splats or entries in all tasks; little work uses no extra thread.
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

    threads = torch.get_num_threads() - 1
    futures = [_workers(os.getpid(), threads).submit(drain) for _ in range(helpers)]
    drain()
    for future in futures:
        # A helper that has not started is no longer needed, and waiting for it could block.
        if not future.cancel():
            future.result()
