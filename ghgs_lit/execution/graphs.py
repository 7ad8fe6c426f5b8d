"""Functions of tensors that are captured once per shape bucket, and replayed as a CUDA graph.

A host that launches thousands of small kernels is slower than the GPU that runs them. A graph
launches all of them at once, but repeats exactly the same work: the same sizes, addresses and host
constants. So a graph is stored under a key of everything that may differ between calls
(:func:`describe_inputs`), inputs are copied to the captured addresses, and functions that read a value of
the device are rejected."""

import threading
import warnings
from collections import Counter, OrderedDict
from collections.abc import Callable, Hashable, Iterator, Sequence
from dataclasses import dataclass, fields, is_dataclass
from typing import Any, TypeVar
from weakref import WeakSet

import torch
from torch import Tensor

from ghgs_lit.execution.capture import CaptureChecks, CudaGraphs, ModelState
from ghgs_lit.geometry.precision import rounding_state
from ghgs_lit.rendering.capacity import Rooms, defer_checks

Result = TypeVar("Result")


@dataclass
class _Graph:
    """Captured graph of one shape bucket.

    Attributes:
        inputs: tensors that inputs are copied to.
        result: result that a replay overwrites.
        replay: launches the graph.
        kept: previously allocated memory that the graph reads, such as cached tables, to keep it alive.
    """

    inputs: list[Tensor]
    result: Any
    replay: Callable[[], None]
    kept: list[Any]


#: Caches of this process.
_caches: WeakSet = WeakSet()


class GraphCache:
    """Calls functions of tensors, and replays them as CUDA graphs after the first call of a shape bucket,
    which is eager: it fills caches, and a bucket that occurs once is not worth a capture. Neither is one that
    recurs only after more buckets than there may be graphs.

    Graphs hold memory. If a call runs out of memory, all graphs of the process are freed, the call is
    repeated, and graphs are captured again later.

    Args:
        limit: largest number of graphs, at least 1; the least recently used one is evicted.
        backend: captures graphs, as :class:`~ghgs_lit.execution.capture.CudaGraphs`, the default.

    Attributes:
        counts: numbers of calls that were ``replayed``, ``captured`` (and replayed), ``eager``,
            ``refused``.
        reasons: reasons why calls were not captured, each once.
    """

    def __init__(self, limit: int = 8, backend: Any = None):
        self.limit = limit
        self.backend = backend or CudaGraphs()
        self.counts: Counter[str] = Counter()
        self.reasons: list[str] = []
        self._lock = threading.RLock()
        self._weights: tuple = ()
        self.clear()
        _caches.add(self)

    def __reduce__(self) -> tuple:
        """Copies start without graphs."""
        return type(self), (self.limit, type(self.backend)(self.backend.device))

    def clear(self) -> None:
        """Free all graphs."""
        self._graphs: OrderedDict[Hashable, _Graph] = OrderedDict()
        self._seen: OrderedDict[Hashable, None] = OrderedDict()
        self._refused: set[Hashable] = set()

    def of_weights(self, state: ModelState) -> ModelState:
        """Free all graphs if they read weights other than those of ``state``, and return it."""
        if state.weights != self._weights:
            self.clear()
            self._weights = state.weights
        return state

    def note(self, reason: str) -> None:
        """Warn once per reason why a call is not captured."""
        if reason not in self.reasons:
            self.reasons.append(reason)
            warnings.warn(f"not captured as a CUDA graph, but called eagerly: {reason}", stacklevel=3)

    def repeat_until_sufficient(
        self, function: Callable[[Any], Result], inputs: Any, key: Hashable = ()
    ) -> Result:
        """:meth:`__call__` of a function that renders, repeated until renderings have enough capacity;
        arguments as for :meth:`__call__`."""

        def render(inputs: Any) -> tuple[Result, Rooms]:
            with defer_checks() as rooms:
                return function(inputs), rooms

        while True:
            result, rooms = self(render, inputs, key)
            if rooms.suffice():
                return result
            # A replay would have the same capacity.
            self._graphs.pop(self._bucket(inputs, key, []), None)

    def __call__(
        self,
        function: Callable[[Any], Result],
        inputs: Any,
        key: Hashable = (),
        written: Sequence[Tensor] = (),
    ) -> Result:
        """Return ``function(inputs)``, without a gradient.

        Args:
            function: depends on ``inputs``, ``key`` and tensors with fixed addresses, and does not write
                its inputs. The first call of a bucket is eager, and so are all calls if the capture
                fails, which is logged once.
            inputs: dataclasses, tuples, lists and dicts of tensors on the backend's device, and of
                anything hashable.
            key: everything else that may change what ``function`` does.
            written: previously allocated memory that ``function`` writes to; a capture leaves it
                unchanged.

        Returns:
            The result, in memory that later calls do not overwrite.
        """
        tensors: list[Tensor] = []
        bucket = self._bucket(inputs, key, tensors)
        with self._lock:
            graph = self._graphs.get(bucket)
            if graph is not None:
                self._graphs.move_to_end(bucket)
                self.counts["replayed"] += 1
            elif self._is_due(bucket):
                graph = self._capture(bucket, function, inputs, tensors, written)
            else:
                self.counts["eager"] += 1
            if graph is not None:
                return _replay(graph, tensors)
        if written:  # such a call cannot be repeated
            return function(inputs)
        return retry_without_graphs(lambda: function(inputs))

    def _is_due(self, bucket: Hashable) -> bool:
        """Note a call of a bucket, and return whether it had its eager call before."""
        if bucket in self._refused:
            return False
        is_known = bucket in self._seen
        self._seen[bucket] = None
        self._seen.move_to_end(bucket)
        if len(self._seen) > self.limit:
            self._seen.popitem(last=False)
        return is_known

    def _capture(
        self,
        bucket: Hashable,
        function: Callable,
        inputs: Any,
        tensors: list[Tensor],
        written: Sequence[Tensor],
    ) -> "_Graph | None":
        """Capture a new graph; None if that fails. Arguments as for :meth:`__call__`."""
        graph = None
        is_full = False
        try:
            # Streams and graphs belong to the current GPU.
            with torch.cuda.device_of(tensors[0]):
                graph = _capture_function(self.backend, function, inputs, written)
        except torch.OutOfMemoryError:
            is_full = True
        except Exception as error:  # drivers fail in many ways
            self._refuse(bucket, " ".join(str(error).split())[:300] or type(error).__name__)
        # Outside the handler, whose traceback keeps all memory of the capture alive.
        if is_full and not free_graphs():
            self._refuse(bucket, "too little memory for a graph")
        if graph is None:
            return None
        while len(self._graphs) >= self.limit:
            self._graphs.popitem(last=False)
        self._graphs[bucket] = graph
        self.counts["captured"] += 1
        return graph

    def _refuse(self, bucket: Hashable, reason: str) -> None:
        """Do not capture a bucket again until graphs are freed."""
        self.counts["refused"] += 1
        self._refused.add(bucket)
        self.note(reason)

    def _bucket(self, inputs: Any, key: Hashable, tensors: list[Tensor]) -> Hashable:
        """Key of the graphs that are valid for a call. Appends the tensors of ``inputs`` to ``tensors``."""
        return key, describe_inputs(inputs, tensors), _torch_state(self.backend.device)


def free_graphs() -> bool:
    """Free the graphs of all caches of the process, and report whether there were any."""
    holders = [cache for cache in list(_caches) if cache._graphs]
    for cache in holders:
        cache.clear()
        cache.note("too little memory was left beside the graphs; they were freed")
    return bool(holders)


def retry_without_graphs(call: Callable[[], Result]) -> Result:
    """Return ``call()``, repeated without graphs if memory runs out."""
    try:
        return call()
    except torch.OutOfMemoryError:
        if not free_graphs():
            raise
    return call()


def describe_inputs(value: Any, tensors: list[Tensor]) -> Any:
    """Describe what a graph requires of ``value``: sizes and types of its tensors, and all other values.

    Cached values of dataclasses, which are not fields, are included.

    Args:
        value: dataclasses, tuples, lists and dicts of tensors and of anything else.
        tensors: list to which the tensors of the value are appended, in order.
    """
    if isinstance(value, Tensor):
        tensors.append(value)
        return tuple(value.shape), value.dtype, value.device
    if is_dataclass(value) and not isinstance(value, type):
        return type(value), tuple((name, describe_inputs(item, tensors)) for name, item in _entries(value))
    if isinstance(value, (tuple, list)):
        return type(value), tuple(describe_inputs(item, tensors) for item in value)
    if isinstance(value, dict):
        return tuple((key, describe_inputs(item, tensors)) for key, item in value.items())
    return type(value), value


def _entries(value: Any) -> Iterator[tuple[str, Any]]:
    """Fields of a dataclass, then its other attributes."""
    names = [field.name for field in fields(value)]
    yield from ((name, getattr(value, name)) for name in names)
    yield from ((name, item) for name, item in vars(value).items() if name not in names)


def _torch_state(device: str) -> Hashable:
    """State of PyTorch that decides which kernels run."""
    autocast = torch.is_autocast_enabled(device) and torch.get_autocast_dtype(device)
    modes = torch.is_grad_enabled(), torch.is_inference_mode_enabled()
    return autocast, modes, torch.are_deterministic_algorithms_enabled(), rounding_state(device)


def _replace_tensors(value: Any, replace: Callable[[Tensor], Tensor]) -> Any:
    """Replace all tensors of ``value``, also in attributes of dataclasses that are not fields."""
    if is_dataclass(value) and not isinstance(value, type):
        names = {field.name for field in fields(value)}
        entries = {name: _replace_tensors(item, replace) for name, item in _entries(value)}
        made = type(value)(**{name: item for name, item in entries.items() if name in names})
        vars(made).update(entries)
        return made
    if isinstance(value, (tuple, list)):
        items = [_replace_tensors(item, replace) for item in value]
        return type(value)(*items) if hasattr(value, "_fields") else type(value)(items)
    if isinstance(value, dict):
        return {key: _replace_tensors(item, replace) for key, item in value.items()}
    return replace(value) if isinstance(value, Tensor) else value


def _capture_function(
    backend: Any, function: Callable[[Any], Any], inputs: Any, written: Sequence[Tensor]
) -> _Graph:
    """Capture ``function(inputs)`` on copies of the inputs, and restore ``written`` afterwards.

    Raises:
        NotCapturable: the function reads a value of the device or copies from the host.
    """
    places: list[Tensor] = []

    def place(tensor: Tensor) -> Tensor:
        places.append(torch.empty_like(tensor).copy_(tensor))
        return places[-1]

    fixed = _replace_tensors(inputs, place)
    checks: list[CaptureChecks] = []

    def call_checked() -> Any:
        # Cached casts of weights would be shared between captured and eager work.
        torch.clear_autocast_cache()
        checks.append(CaptureChecks())
        # A fresh copy: values that the first call caches in dataclasses must be computed by the graph.
        fresh = _replace_tensors(fixed, lambda tensor: tensor)
        with checks[-1]:
            return function(fresh)

    values = [tensor.clone() for tensor in written]
    try:
        result, replay = backend.capture(call_checked)
    finally:
        torch.clear_autocast_cache()  # casts from a failed capture were never computed
        with torch.no_grad():
            _copy_all(written, values)
    return _Graph(places, result, replay, list(checks[-1].kept.values()))


def _replay(graph: _Graph, tensors: list[Tensor]) -> Any:
    """Replay a graph with other input tensors, in the order of :func:`describe_inputs`; returns a copy of
    the result."""
    _copy_all(graph.inputs, tensors)
    graph.replay()
    results: dict[int, Tensor] = {}

    def collect(tensor: Tensor) -> Tensor:
        results[id(tensor)] = tensor
        return tensor

    _replace_tensors(graph.result, collect)
    copies = {key: torch.empty_like(tensor) for key, tensor in results.items()}
    _copy_all(list(copies.values()), list(results.values()))
    return _replace_tensors(graph.result, lambda tensor: copies[id(tensor)])


def _copy_all(places: Sequence[Tensor], sources: Sequence[Tensor]) -> None:
    """Copy ``sources`` to ``places`` of the same sizes, with one launch per dtype."""
    groups: dict[tuple, tuple[list[Tensor], list[Tensor]]] = {}
    for place, source in zip(places, sources, strict=True):
        # A single pair with another dtype or layout would make PyTorch copy all pairs one by one.
        kind = (source.dtype, source.device, place.stride() == source.stride())
        group = groups.setdefault(kind, ([], []))
        group[0].append(place)
        group[1].append(source)
    for group in groups.values():
        torch._foreach_copy_(*group)
