"""CUDA graphs: how work is captured, and what cannot be."""

import threading
import traceback
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any, Protocol, TypeVar
from weakref import WeakSet

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

Result = TypeVar("Result")


class CaptureBackend(Protocol):
    """Captures calls on devices of one type, ``device``."""

    device: str

    def capture(self, call: Callable[[], Result]) -> tuple[Result, Callable[[], None]]:
        """The result of a call, and a function that fills it again from the same inputs."""


#: A process captures one graph at a time.
_alone = threading.RLock()


@cache
def _side_stream(device: int) -> Any:
    """The stream on which all is captured on a GPU. Graphs share the memory of a pool, and
    the workspaces of products, on one stream alone.

    Args:
        device: its number; it is the current one.
    """
    return torch.cuda.Stream(device)


class CudaGraphs:
    """CUDA graphs. One pool of memory for all,
    since none is replayed while another's results are needed."""

    def __init__(self, device: str = "cuda") -> None:
        self.device = device
        self._pool: Any = None
        self._graphs: WeakSet = WeakSet()

    def capture(self, call: Callable[[], Result]) -> tuple[Result, Callable[[], None]]:
        """See :class:`CaptureBackend`. The call is made once before on the stream that captures,
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
        """Undo what PyTorch leaves where a capture fails: its stream is the current one, and the
        allocator believes that it goes on.

        Args:
            before: the stream that was current.
        """
        with suppress(Exception):  # it has ended, or another version of PyTorch
            torch._C._cuda_endAllocateToPool(torch.cuda.current_device(), self._pool)
        torch.cuda.set_stream(before)
        self._graphs = WeakSet()


_PACKAGE = Path(__file__).parents[1]
#: Files whose lines do not explain a failure.
_OWN = ("graphs.py", Path(__file__).name)


class NotCapturable(RuntimeError):
    """What cannot be captured: an operator, or a model with hooks or replaced methods, which a graph
    would not call. The message names the reason and the place."""


class CaptureChecks(TorchDispatchMode):
    """Rejects what a graph cannot repeat, before it is done.

    That is: reading a value of the device, and copying from the host, whose memory will hold
    something else.

    Attributes:
        kept: memory that was not made inside, by its address.
    """

    def __init__(self) -> None:
        super().__init__()
        self.kept: dict[int, Any] = {}
        self._made: set[int] = set()

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        """Call an operator of PyTorch if it can be replayed.

        Args:
            function: the operator.
            types: PyTorch's: classes of the tensors.
            args: its positional arguments.
            kwargs: its named arguments.

        Raises:
            NotCapturable: it cannot.
        """
        kwargs = kwargs or {}
        given = list(_tensors((args, tuple(kwargs.values()))))
        reason = _reason(function, given, args, kwargs)
        if reason is not None:
            raise NotCapturable(f"{reason} by {function.name()} ({_line()})")
        for storage in map(Tensor.untyped_storage, given):
            if storage._cdata not in self._made:
                self.kept[storage._cdata] = storage
        result = function(*args, **kwargs)
        self._made.update(tensor.untyped_storage()._cdata for tensor in _tensors(result))
        return result


def _tensors(value: Any) -> Iterator[Tensor]:
    if isinstance(value, Tensor):
        yield value
    elif isinstance(value, (tuple, list)):
        for item in value:
            yield from _tensors(item)


_INDEXING = ("aten::index", "aten::index_put", "aten::index_put_", "aten::_unsafe_index")


def _reason(function: Any, given: list[Tensor], args: tuple, kwargs: dict) -> str | None:
    """Why an operator cannot be replayed; None if it can.

    Args:
        function: the operator.
        given: tensors among its arguments.
        args: its positional arguments.
        kwargs: its named arguments.
    """
    name = function.name().split(".")[0]
    if torch.Tag.data_dependent_output in function.tags:
        return "a value is read"
    if name in _INDEXING:
        masks = [index for index in args[1] if index is not None and index.dtype in (torch.bool, torch.uint8)]
        return "a size depends on values" if masks else None
    sized = kwargs.get("output_size") is not None
    if torch.Tag.dynamic_output_shape in function.tags and not sized:
        return "a size depends on values"
    types = {tensor.device.type for tensor in given}
    if name in ("aten::_to_copy", "aten::copy_", "aten::_copy_from") and kwargs.get("device") is not None:
        target = torch.device(kwargs["device"]).type
        types.add(target)
        if target == "cpu" and len(types) > 1:
            return "a value is read"
    copies = len(types) > 1 and (name == "aten::_to_copy" or "copy_" in name)
    # What remains to be seen of torch.tensor(list, device=...).
    copies |= name == "aten::lift_fresh" and types != {"cpu"}
    return "the host's memory is copied" if copies else None


def _line() -> str:
    """The innermost line of the package that is running."""
    lines = [f for f in traceback.extract_stack() if Path(f.filename).is_relative_to(_PACKAGE)]
    lines = [f for f in lines if Path(f.filename).name not in _OWN]
    return f"{Path(lines[-1].filename).name}:{lines[-1].lineno}" if lines else "no line of the package"
