"""Work of a GPU that is recorded once for each class of inputs and then played back as
one CUDA graph.

A host that starts thousands of small kernels is slower than the GPU that runs them. A recording
starts all of them at once. It repeats the very same work: the same sizes, the same addresses, the
same numbers of the host. So a call is recorded together with all that may differ between calls
(:func:`described`), its inputs are copied to the places that were recorded, and functions that read
a value of the device are refused."""

import threading
import warnings
from collections import Counter, OrderedDict
from collections.abc import Callable, Hashable, Iterator, Sequence
from dataclasses import dataclass, fields, is_dataclass
from typing import Any, TypeVar
from weakref import WeakSet

import torch
from torch import Tensor

from ghgs_lit.runtime.precision import rounding_state
from ghgs_lit.runtime.repeatable import Guard
from ghgs_lit.runtime.tape import CudaTape, Tape

Result = TypeVar("Result")


@dataclass
class _Recording:
    """What was recorded for one class of inputs.

    Attributes:
        inputs: where the tensors of inputs are copied to.
        result: where the result comes about.
        play: does the work again.
        kept: memory that is read and that was there before, such as tables in caches,
            which may forget them.
    """

    inputs: list[Tensor]
    result: Any
    play: Callable[[], None]
    kept: list[Any]


#: Recorders of this process.
_recorders: WeakSet = WeakSet()


class Recorder:
    """Calls functions of tensors, and plays them back from the second call of a class on.

    Recordings keep memory. Where an eager call finds too little of it, all recordings of the process
    are forgotten, recorders that had some make no more, which is said, and the call is repeated.

    Args:
        limit: largest number of recordings, at least 1;
            the one that was not used for longest makes room.
        eager: calls of a class before it is recorded: what comes once is not worth it, and
            caches are filled.
        tape: makes recordings; None: CUDA graphs.
        recent: number of classes that eager calls are remembered of; None: 64 for each
            recording. A class that comes again only after more than there are recordings would
            be recorded in vain.

    Attributes:
        counts: calls that were ``played``, ``recorded`` (and played), ``eager``, ``refused``.
        reason: why the last recording failed; empty if none did.
    """

    def __init__(self, limit: int = 8, eager: int = 1, tape: Tape | None = None, recent: int | None = None):
        self.limit = limit
        self.eager = eager
        self.recent = recent or 64 * limit
        self.tape = tape or CudaTape()
        self.counts: Counter[str] = Counter()
        self.reason = ""
        self._lock = threading.RLock()
        self.clear()
        _recorders.add(self)

    def __reduce__(self) -> tuple:
        """Copies of a model record anew."""
        return type(self), (self.limit, self.eager, type(self.tape)(self.tape.device), self.recent)

    def clear(self) -> None:
        """Forget all recordings: after weights have moved."""
        self._recordings: OrderedDict[Hashable, _Recording] = OrderedDict()
        self._seen: OrderedDict[Hashable, int] = OrderedDict()
        self._refused: set[Hashable] = set()

    def forget(self, inputs: Any, key: Hashable = ()) -> None:
        """Forget the recording of the class of ``inputs``, if there is one.

        Args:
            inputs: as of :meth:`__call__`.
            key: as of :meth:`__call__`.
        """
        self._recordings.pop(self._class(inputs, key, []), None)

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
                writes none of its inputs. The first call of a class is eager, and so are all where
                recording fails, which is said once.
            inputs: dataclasses, tuples, lists and dicts of tensors on one device, and of anything
                hashable.
            key: all else that may change what ``function`` does.
            written: memory that ``function`` writes to and that was there before. Recording calls
                it without effect.

        Returns:
            Its result, in memory that later calls do not write to.
        """
        tensors: list[Tensor] = []
        kind = self._class(inputs, key, tensors)
        devices = {tensor.device for tensor in tensors}
        is_here = len(devices) == 1 and devices.pop().type == self.tape.device
        if kind is None or kind in self._refused or not is_here or not self.limit:
            self.counts["eager"] += 1
            return self._called(function, inputs, written)
        with self._lock:
            if kind in self._recordings:
                self._recordings.move_to_end(kind)
                self.counts["played"] += 1
                return _played(self._recordings[kind], tensors)
            if self._seen.get(kind, 0) < self.eager:
                self._note(kind)
                self.counts["eager"] += 1
                return self._called(function, inputs, written)
            try:
                # Streams and graphs belong to the current GPU.
                with torch.cuda.device_of(tensors[0]):
                    recording = _recorded(self.tape, function, inputs, written)
            except Exception as error:  # a driver has many ways to fail
                self._refuse(kind, error)
                recording = None
            # Not where the error is known, which keeps all memory of the recording.
            if recording is None:
                return self._called(function, inputs, written)
            while len(self._recordings) >= self.limit:
                self._recordings.popitem(last=False)
            self._recordings[kind] = recording
            self.counts["recorded"] += 1
            return _played(recording, tensors)

    def _called(self, function: Callable[[Any], Result], inputs: Any, written: Sequence[Tensor]) -> Result:
        """``function(inputs)``, once more where recordings left too little memory for it.

        Args:
            function: as of :meth:`__call__`.
            inputs: as of :meth:`__call__`.
            written: as of :meth:`__call__`; with some of it a call cannot be repeated.
        """
        try:
            return function(inputs)
        except torch.OutOfMemoryError:
            holders = [recorder for recorder in list(_recorders) if recorder._recordings]
            if written or not holders:
                raise
            for recorder in holders:
                recorder.clear()
                recorder.limit = 0
        warnings.warn("CUDA graphs: too little memory is left, none is recorded any more", stacklevel=4)
        return function(inputs)

    def _class(self, inputs: Any, key: Hashable, tensors: list[Tensor]) -> Hashable | None:
        """What must be equal for a recording to be valid; None: it cannot be told.

        Args:
            inputs: as of :meth:`__call__`.
            key: as of :meth:`__call__`.
            tensors: gets the tensors of the inputs, in their order.
        """
        kind = (key, described(inputs, tensors), _surroundings(self.tape.device))
        try:
            hash(kind)
        except TypeError:
            return None
        return kind

    def _note(self, kind: Hashable) -> None:
        self._seen[kind] = self._seen.pop(kind, 0) + 1
        while len(self._seen) > self.recent:
            self._seen.popitem(last=False)

    def _refuse(self, kind: Hashable, error: Exception) -> None:
        self.counts["refused"] += 1
        earlier_reason = self.reason
        self.reason = " ".join(str(error).split())[:300] or type(error).__name__
        if not earlier_reason:
            warnings.warn(f"not recorded as a CUDA graph, but called as always: {self.reason}", stacklevel=4)
        self._refused.add(kind)


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


def _recorded(
    tape: Tape, function: Callable[[Any], Any], inputs: Any, written: Sequence[Tensor]
) -> _Recording:
    """Record ``function(inputs)``.

    Args:
        tape: makes the recording.
        function: as of :meth:`Recorder.__call__`.
        inputs: as of :meth:`Recorder.__call__`; they are copied.
        written: as of :meth:`Recorder.__call__`; as before in the end.

    Raises:
        NotRecordable: the function reads a value of the device or copies from the host.
    """
    places: list[Tensor] = []

    def place(tensor: Tensor) -> Tensor:
        places.append(torch.empty_like(tensor).copy_(tensor))
        return places[-1]

    fixed = _replaced(inputs, place)
    guards: list[Guard] = []

    def guarded() -> Any:
        # Casts of weights would be shared between what is recorded and what is not.
        torch.clear_autocast_cache()
        guards.append(Guard())
        # What the first call computes and keeps beside fields must be computed by the recording.
        fresh = _replaced(fixed, lambda tensor: tensor)
        with guards[-1]:
            return function(fresh)

    values = [tensor.clone() for tensor in written]
    try:
        result, play = tape.record(guarded)
    finally:
        torch.clear_autocast_cache()  # of a recording that failed, casts are no numbers
        with torch.no_grad():
            _copy_all(written, values)
    return _Recording(places, result, play, list(guards[-1].kept.values()))


def _played(recording: _Recording, tensors: list[Tensor]) -> Any:
    """The result for other values, in memory of its own.

    Args:
        recording: of the class of the inputs.
        tensors: of the inputs, in the order of :func:`described`.
    """
    _copy_all(recording.inputs, tensors)
    recording.play()
    results: dict[int, Tensor] = {}

    def noted(tensor: Tensor) -> Tensor:
        results[id(tensor)] = tensor
        return tensor

    _replaced(recording.result, noted)
    copies = {key: torch.empty_like(tensor) for key, tensor in results.items()}
    _copy_all(list(copies.values()), list(results.values()))
    return _replaced(recording.result, lambda tensor: copies[id(tensor)])


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
