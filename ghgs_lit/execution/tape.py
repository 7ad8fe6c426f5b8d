"""CUDA graphs, made on a stream of their own."""

import threading
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from typing import Any, Protocol, TypeVar
from weakref import WeakSet

import torch

Result = TypeVar("Result")


class Tape(Protocol):
    """Records calls on devices of one type, ``device``."""

    device: str

    def record(self, call: Callable[[], Result]) -> tuple[Result, Callable[[], None]]:
        """The result of a call, and a function that fills it again from the same inputs."""


#: A process records one graph at a time.
_alone = threading.RLock()


@cache
def _side_stream(device: int) -> Any:
    """The stream on which all is recorded on a GPU. Recordings share the memory of a pool, and
    the workspaces of products, on one stream alone.

    Args:
        device: its number; it is the current one.
    """
    return torch.cuda.Stream(device)


class CudaTape:
    """CUDA graphs. One pool of memory for all,
    since none is played while another's results are needed."""

    def __init__(self, device: str = "cuda") -> None:
        self.device = device
        self._pool: Any = None
        self._graphs: WeakSet = WeakSet()

    def record(self, call: Callable[[], Result]) -> tuple[Result, Callable[[], None]]:
        """See :class:`Tape`. The call is made once before on the stream that records,
        for workspaces.

        Args:
            call: starts work of the current GPU alone.
        """
        with _alone:
            before = torch.cuda.current_stream()
            stream = _side_stream(torch.cuda.current_device())
            stream.wait_stream(before)
            try:
                with torch.cuda.stream(stream):
                    call()
            finally:
                before.wait_stream(stream)
            if not self._graphs:  # PyTorch refuses a pool that no graph needs any more
                self._pool = torch.cuda.graph_pool_handle()
            graph = torch.cuda.CUDAGraph()
            options = {"pool": self._pool, "stream": stream}
            try:
                # Other threads may work meanwhile: that which pins memory of the next batch,
                # that of the gradients.
                with torch.cuda.graph(graph, **options, capture_error_mode="thread_local"):
                    result = call()
            except BaseException:
                self._end(before)
                raise
            self._graphs.add(graph)
        return result, graph.replay

    def _end(self, before: Any) -> None:
        """Undo what PyTorch leaves where a recording fails: its stream is the current one, and the
        allocator believes that it goes on.

        Args:
            before: the stream that was current.
        """
        with suppress(Exception):  # it has ended, or another version of PyTorch
            torch._C._cuda_endAllocateToPool(torch.cuda.current_device(), self._pool)
        torch.cuda.set_stream(before)
        self._graphs = WeakSet()
