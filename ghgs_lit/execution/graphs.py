"""Functions of tensors that are captured once for each shape bucket and then replayed as one CUDA
graph.

A host that launches thousands of small kernels is slower than the GPU that runs them. A graph
launches all of them at once. It repeats the very same work: the same sizes, the same addresses, the
same numbers of the host. So a call is captured together with all that may differ between calls
(:func:`described`), its inputs are copied to the places that were captured, and functions that read
a value of the device are rejected."""

import threading
import warnings
from collections import Counter, OrderedDict
from collections.abc import Callable, Hashable, Iterator, Sequence
from dataclasses import dataclass, fields, is_dataclass
from typing import Any, TypeVar
from weakref import WeakSet

import torch
from torch import Tensor

from ghgs_lit.execution.capture import CaptureBackend, CaptureChecks, CudaGraphs
from ghgs_lit.execution.state import ModelState
from ghgs_lit.geometry.precision import rounding_state
from ghgs_lit.rendering.capacity import Rooms, deferred

Result = TypeVar("Result")


@dataclass
class _Graph:
    """What was captured for one shape bucket.

    Attributes:
        inputs: where the tensors of inputs are copied to.
        result: where the result comes about.
        replay: does the work again.
        kept: memory that is read and that was there before, such as tables in caches,
            which may forget them.
    """

    inputs: list[Tensor]
    result: Any
    replay: Callable[[], None]
    kept: list[Any]


#: Caches of this process.
_caches: WeakSet = WeakSet()


class GraphCache:
    """Calls functions of tensors, and replays them as CUDA graphs from the second call of a shape
    bucket on.

    Graphs keep memory. Where a call finds too little of it, all graphs of the process are freed, the
    call is repeated, and graphs are captured anew later on.

    Args:
        limit: largest number of graphs, at least 1; the least recently used one makes room.
        eager: calls of a bucket before it is captured: what comes once is not worth it, and
            caches are filled.
        backend: captures graphs; None: CUDA graphs.
        recent: number of buckets whose eager calls are remembered; None: 64 for each graph. A
            bucket that returns only after more than there are graphs would be captured in vain.

    Attributes:
        counts: calls that were ``replayed``, ``captured`` (and replayed), ``eager``, ``refused``.
        reasons: why calls were not captured, each once.
    """

    def __init__(
        self, limit: int = 8, eager: int = 1, backend: CaptureBackend | None = None, recent: int | None = None
    ):
        self.limit = limit
        self.eager = eager
        self.recent = recent or 64 * limit
        self.backend = backend or CudaGraphs()
        self.counts: Counter[str] = Counter()
        self.reasons: list[str] = []
        self._lock = threading.RLock()
        self._weights: tuple = ()
        self.clear()
        _caches.add(self)

    def __reduce__(self) -> tuple:
        """Copies capture anew."""
        return type(self), (self.limit, self.eager, type(self.backend)(self.backend.device), self.recent)

    def clear(self) -> None:
        """Free all graphs."""
        self._graphs: OrderedDict[Hashable, _Graph] = OrderedDict()
        self._seen: OrderedDict[Hashable, int] = OrderedDict()
        self._refused: set[Hashable] = set()

    def of_weights(self, state: ModelState) -> ModelState:
        """Free all graphs if they read other weights than those of a state.

        Args:
            state: of the model that is captured.
        """
        if state.weights != self._weights:
            self.clear()
            self._weights = state.weights
        return state

    def note(self, reason: str) -> None:
        """Log once why a call is not captured."""
        if reason not in self.reasons:
            self.reasons.append(reason)
            warnings.warn(f"not captured as a CUDA graph, but called eagerly: {reason}", stacklevel=3)

    def settled(self, function: Callable[[Any], Result], inputs: Any, key: Hashable = ()) -> Result:
        """:meth:`__call__` of a function that renders, repeated until renderings have room enough.

        Args:
            function: as of :meth:`__call__`.
            inputs: as of :meth:`__call__`.
            key: as of :meth:`__call__`.
        """

        def rendered(inputs: Any) -> tuple[Result, Rooms]:
            with deferred() as rooms:
                return function(inputs), rooms

        while True:
            result, rooms = self(rendered, inputs, key)
            if rooms.suffice():
                return result
            # A replay would have as little room.
            self._graphs.pop(self._bucket(inputs, key, []), None)

    def __call__(
        self,
        function: Callable[[Any], Result],
        inputs: Any,
        key: Hashable = (),
        written: Sequence[Tensor] = (),
    ) -> Result:
        """``function(inputs)``, without a gradient.

        Args:
            function: depends on ``inputs``, ``key`` and on tensors that stay where they are, and
                writes none of its inputs. The first call of a bucket is eager, and so are all where
                the capture fails, which is logged once.
            inputs: dataclasses, tuples, lists and dicts of tensors on one device, and of anything
                hashable.
            key: all else that may change what ``function`` does.
            written: memory that ``function`` writes to and that was there before. The capture calls
                it without effect.

        Returns:
            Its result, in memory that later calls do not write to.
        """
        tensors: list[Tensor] = []
        bucket = self._bucket(inputs, key, tensors)
        devices = {tensor.device for tensor in tensors}
        is_here = len(devices) == 1 and devices.pop().type == self.backend.device
        if bucket is not None and is_here:
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
                    return _replayed(graph, tensors)
        else:
            self.counts["eager"] += 1
        return self._called(function, inputs, written)

    def _is_due(self, bucket: Hashable) -> bool:
        """Whether a bucket had its eager calls; this one is counted."""
        if bucket in self._refused:
            return False
        before = self._seen.pop(bucket, 0)
        self._seen[bucket] = before + 1
        while len(self._seen) > self.recent:
            self._seen.popitem(last=False)
        return before >= self.eager

    def _capture(
        self,
        bucket: Hashable,
        function: Callable,
        inputs: Any,
        tensors: list[Tensor],
        written: Sequence[Tensor],
    ) -> "_Graph | None":
        """A new graph; None where it cannot be captured. Arguments as of :meth:`__call__`."""
        graph = None
        is_full = False
        try:
            # Streams and graphs belong to the current GPU.
            with torch.cuda.device_of(tensors[0]):
                graph = _captured(self.backend, function, inputs, written)
        except torch.OutOfMemoryError:
            is_full = True
        except Exception as error:  # a driver has many ways to fail
            self._refuse(bucket, " ".join(str(error).split())[:300] or type(error).__name__)
        # Not where the error is known, which keeps all memory of the capture.
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
        """Capture a bucket no more, until graphs are freed."""
        self.counts["refused"] += 1
        self._refused.add(bucket)
        self.note(reason)

    def _called(self, function: Callable[[Any], Result], inputs: Any, written: Sequence[Tensor]) -> Result:
        """``function(inputs)``, once more where graphs left too little memory for it.

        Args:
            function: as of :meth:`__call__`.
            inputs: as of :meth:`__call__`.
            written: as of :meth:`__call__`; with some of it a call cannot be repeated.
        """
        if written:
            return function(inputs)
        return with_memory(lambda: function(inputs))

    def _bucket(self, inputs: Any, key: Hashable, tensors: list[Tensor]) -> Hashable | None:
        """What must be equal for a graph to be valid; None: it is not hashable.

        Args:
            inputs: as of :meth:`__call__`.
            key: as of :meth:`__call__`.
            tensors: gets the tensors of the inputs, in their order.
        """
        bucket = (key, described(inputs, tensors), _surroundings(self.backend.device))
        try:
            hash(bucket)
        except TypeError:
            return None
        return bucket


def free_graphs() -> bool:
    """Free the graphs of all caches of the process, and report whether there were any."""
    holders = [cache for cache in list(_caches) if cache._graphs]
    for cache in holders:
        cache.clear()
        cache.note("too little memory was left beside the graphs; they were freed")
    return bool(holders)


def with_memory(call: Callable[[], Result]) -> Result:
    """The result of a call, once more without graphs where they left too little memory for it."""
    try:
        return call()
    except torch.OutOfMemoryError:
        if not free_graphs():
            raise
    return call()


def described(value: Any, tensors: list[Tensor]) -> Any:
    """What is fixed in ``value``: sizes and types of its tensors, and all that is no tensor.

    Values that dataclasses keep beside their fields belong to them.

    Args:
        value: dataclasses, tuples, lists and dicts of tensors and of anything else.
        tensors: gets the tensors of the value, in their order.
    """
    if isinstance(value, Tensor):
        tensors.append(value)
        return tuple(value.shape), value.dtype, value.device
    if is_dataclass(value) and not isinstance(value, type):
        return type(value), tuple((name, described(item, tensors)) for name, item in _entries(value))
    if isinstance(value, (tuple, list)):
        return type(value), tuple(described(item, tensors) for item in value)
    if isinstance(value, dict):
        return tuple((key, described(item, tensors)) for key, item in value.items())
    return type(value), value


def _entries(value: Any) -> Iterator[tuple[str, Any]]:
    """Fields of a dataclass, then what it keeps beside them."""
    names = [field.name for field in fields(value)]
    yield from ((name, getattr(value, name)) for name in names)
    yield from ((name, item) for name, item in vars(value).items() if name not in names)


def _surroundings(device: str) -> Hashable:
    """State of PyTorch that decides which kernels run."""
    autocast = torch.is_autocast_enabled(device) and torch.get_autocast_dtype(device)
    modes = torch.is_grad_enabled(), torch.is_inference_mode_enabled()
    return autocast, modes, torch.are_deterministic_algorithms_enabled(), rounding_state(device)


def _replaced(value: Any, replace: Callable[[Tensor], Tensor]) -> Any:
    """``value`` with other tensors, also in what dataclasses keep beside their fields."""
    if is_dataclass(value) and not isinstance(value, type):
        names = {field.name for field in fields(value)}
        entries = {name: _replaced(item, replace) for name, item in _entries(value)}
        made = type(value)(**{name: item for name, item in entries.items() if name in names})
        vars(made).update(entries)
        return made
    if isinstance(value, (tuple, list)):
        items = [_replaced(item, replace) for item in value]
        return type(value)(*items) if hasattr(value, "_fields") else type(value)(items)
    if isinstance(value, dict):
        return {key: _replaced(item, replace) for key, item in value.items()}
    return replace(value) if isinstance(value, Tensor) else value


def _captured(
    backend: CaptureBackend, function: Callable[[Any], Any], inputs: Any, written: Sequence[Tensor]
) -> _Graph:
    """Capture ``function(inputs)``.

    Args:
        backend: captures graphs.
        function: as of :meth:`GraphCache.__call__`.
        inputs: as of :meth:`GraphCache.__call__`; they are copied.
        written: as of :meth:`GraphCache.__call__`; as before in the end.

    Raises:
        NotCapturable: the function reads a value of the device or copies from the host.
    """
    places: list[Tensor] = []

    def place(tensor: Tensor) -> Tensor:
        places.append(torch.empty_like(tensor).copy_(tensor))
        return places[-1]

    fixed = _replaced(inputs, place)
    checks: list[CaptureChecks] = []

    def checked() -> Any:
        # Casts of weights would be shared between what is captured and what is not.
        torch.clear_autocast_cache()
        checks.append(CaptureChecks())
        # What the first call computes and keeps beside fields must be computed by the graph.
        fresh = _replaced(fixed, lambda tensor: tensor)
        with checks[-1]:
            return function(fresh)

    values = [tensor.clone() for tensor in written]
    try:
        result, replay = backend.capture(checked)
    finally:
        torch.clear_autocast_cache()  # of a capture that failed, casts are no numbers
        with torch.no_grad():
            _copy_all(written, values)
    return _Graph(places, result, replay, list(checks[-1].kept.values()))


def _replayed(graph: _Graph, tensors: list[Tensor]) -> Any:
    """The result for other values, in memory of its own.

    Args:
        graph: of the bucket of the inputs.
        tensors: of the inputs, in the order of :func:`described`.
    """
    _copy_all(graph.inputs, tensors)
    graph.replay()
    results: dict[int, Tensor] = {}

    def noted(tensor: Tensor) -> Tensor:
        results[id(tensor)] = tensor
        return tensor

    _replaced(graph.result, noted)
    copies = {key: torch.empty_like(tensor) for key, tensor in results.items()}
    _copy_all(list(copies.values()), list(results.values()))
    return _replaced(graph.result, lambda tensor: copies[id(tensor)])


def _copy_all(places: Sequence[Tensor], sources: Sequence[Tensor]) -> None:
    """Copy tensors to others of their sizes, with a launch for each type.

    Args:
        places: written.
        sources: of the same types.
    """
    groups: dict[tuple, tuple[list[Tensor], list[Tensor]]] = {}
    for place, source in zip(places, sources, strict=True):
        # One pair of another type, or that lies in memory otherwise,
        # makes PyTorch copy all one by one.
        kind = (source.dtype, source.device, place.stride() == source.stride())
        group = groups.setdefault(kind, ([], []))
        group[0].append(place)
        group[1].append(source)
    for group in groups.values():
        torch._foreach_copy_(*group)
