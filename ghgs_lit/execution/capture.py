"""CUDA-graph capture, detection of operators that cannot be captured, and the state of a model that a
captured graph depends on besides its inputs."""

import threading
from collections.abc import Callable, Hashable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple, TypeVar
from weakref import WeakSet

import torch
from torch import Tensor, nn
from torch.nn.modules import module as torch_module
from torch.utils._python_dispatch import TorchDispatchMode

from ghgs_lit.runtime.watching import Wrapped

Result = TypeVar("Result")


#: A process captures one graph at a time.
_alone = threading.RLock()


@cache
def _side_stream(device: int) -> Any:
    """The stream for all captures on a GPU, which must be the current one.

    Graphs share the memory of a pool, and the workspaces of matrix products, only on one stream."""
    return torch.cuda.Stream(device)


class CudaGraphs:
    """CUDA graphs with a common memory pool, since none is replayed while another's results are in use."""

    def __init__(self, device: str = "cuda") -> None:
        self.device = device
        self._pool: Any = None
        self._graphs: WeakSet = WeakSet()

    def capture(self, call: Callable[[], Result]) -> tuple[Result, Callable[[], None]]:
        """Capture a call; it is first made once on the capture stream, to allocate workspaces.

        Args:
            call: launches work on the current GPU only.

        Returns:
            The result of the call, and a function that recomputes it in place.
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
            if not self._graphs:  # PyTorch rejects a pool whose graphs are all gone
                self._pool = torch.cuda.graph_pool_handle()
            graph = torch.cuda.CUDAGraph()
            options = {"pool": self._pool, "stream": stream}
            try:
                # Other threads may use CUDA meanwhile: to pin memory of the next batch, or in autograd.
                with torch.cuda.graph(graph, **options, capture_error_mode="thread_local"):
                    result = call()
            except BaseException:
                self._end(before)
                raise
            self._graphs.add(graph)
        return result, graph.replay

    def _end(self, before: Any) -> None:
        """Clean up after a failed capture: PyTorch leaves its stream current, and its allocator in capture
        mode; ``before`` is the previous stream."""
        with suppress(Exception):  # already ended, or another version of PyTorch
            torch._C._cuda_endAllocateToPool(torch.cuda.current_device(), self._pool)
        torch.cuda.set_stream(before)
        self._graphs = WeakSet()


class NotCapturable(RuntimeError):
    """An operator cannot be captured, or a model has hooks or replaced methods, which a graph would not
    call. The message gives the reason."""


class CaptureChecks(TorchDispatchMode):
    """Rejects operators that a graph cannot replay, before they run.

    These read a value of the device, or copy from host memory, whose content will have changed.

    Attributes:
        kept: storages in use that were allocated outside, by address.
    """

    def __init__(self) -> None:
        super().__init__()
        self.kept: dict[int, Any] = {}
        self._made: set[int] = set()

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        """Call an operator if it can be replayed.

        Raises:
            NotCapturable: it cannot.
        """
        kwargs = kwargs or {}
        given = list(_tensors((args, tuple(kwargs.values()))))
        reason = _reason(function, given, args, kwargs)
        if reason is not None:
            raise NotCapturable(f"{reason} by {function.name()}")
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
    """Reason why an operator cannot be replayed, None if it can; ``given`` are its tensor arguments."""
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
    # The only visible operator of torch.tensor(list, device=...).
    copies |= name == "aten::lift_fresh" and types != {"cpu"}
    return "the host's memory is copied" if copies else None


_SIMPLE = (str, int, float, bool, type(None))
#: Attributes that every module has.
_COMMON = frozenset(vars(nn.Module())) - {"training"}
_HOOKS = ("_forward_hooks", "_forward_pre_hooks", "_backward_hooks", "_backward_pre_hooks")


class ModelState(NamedTuple):
    """Weights and settings that a model's computation depends on.

    Attributes:
        weights: identity and address of all parameters and buffers.
        settings: all other attributes.
    """

    weights: tuple
    settings: tuple


@dataclass(frozen=True, eq=False)
class Same:
    """Compares an object by identity, and keeps it alive."""

    value: Any

    def __hash__(self) -> int:
        return id(self.value)

    def __eq__(self, other: Any) -> bool:
        return isinstance(other, Same) and self.value is other.value


def state_of(model: nn.Module) -> ModelState:
    """Get the state of a model to be captured.

    Raises:
        NotCapturable: a module has hooks or a replaced method.
    """
    if torch_module._has_any_global_hook():
        raise NotCapturable("hooks of all modules")
    weights: list[Hashable] = []
    settings: list[Hashable] = []
    for name, part in model.named_modules():
        values = vars(part)
        if any(values[hooks] for hooks in _HOOKS):
            raise NotCapturable(f"a hook of {name or 'the model'}")
        settings.append(Same(part))
        for attribute, value in values.items():
            if attribute in _COMMON:
                continue
            if isinstance(value, Wrapped) or (callable(value) and hasattr(type(part), attribute)):
                raise NotCapturable(f"{f'{name}.' * bool(name)}{attribute} is replaced")
            settings.append((attribute, _key(value)))
        for tensor in (*part._parameters.values(), *part._buffers.values()):
            if tensor is not None:
                weights.append((id(tensor), tensor.data_ptr()))
    return ModelState(tuple(weights), tuple(settings))


def _key(value: Any, is_whole: bool = True) -> Hashable:
    """Key of an attribute's value that is equal for equal settings; ``is_whole``: includes attributes of
    an object."""
    if isinstance(value, _SIMPLE):
        return value
    if isinstance(value, (tuple, list)):
        return tuple(_key(item, False) for item in value)
    if isinstance(value, dict):
        return tuple((key, _key(item, False)) for key, item in value.items())
    if is_whole and hasattr(value, "__dict__"):
        return Same(value), _key(vars(value))
    return Same(value)
