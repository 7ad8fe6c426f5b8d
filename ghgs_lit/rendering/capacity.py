"""Capacity of the buffers for intersections of splats with tiles.

Reading the number of intersections would synchronise device and host before anything is rendered. So
each rendering gets the capacity that similar ones needed, with a margin; the number that it really
needed is read later: while the GPU renders, or after several renderings
(:func:`repeat_until_sufficient`). If the capacity was too small, the rendering is repeated with enough:
an image never lacks splats."""

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from typing import TypeVar

import torch
from jaxtyping import Int
from torch import Tensor

from ghgs_lit.extents import bucket_size

T = TypeVar("T")
Drawn = TypeVar("Drawn")
#: Initial estimate of the number of tiles that a splat touches, and safety factor of capacities.
_FIRST = 4.0
_SPARE = 1.25
#: Fraction of the difference by which the estimate decreases if less was needed; it increases at once.
_FALL = 0.1

#: Tiles of an image (rows, columns), the key of the estimates.
Grid = tuple[int, int]
_expected: dict[Grid, float] = {}


@dataclass(frozen=True)
class Room:
    """Capacity that a rendering had, and what it needed.

    Attributes:
        grid: tiles of an image (rows, columns).
        splats: number of splats of all images together.
        capacity: largest number of intersections in the buffers.
        needed: actual number of intersections, a scalar on the device of the rendering.
    """

    grid: Grid
    splats: int
    capacity: int
    needed: Int[Tensor, ""]

    def expect(self, needed: int) -> bool:
        """Update the estimate for later renderings of the same grid; returns whether the capacity
        sufficed for ``needed`` intersections."""
        per_splat = needed / self.splats
        before = _expected.get(self.grid, 0.0)
        _expected[self.grid] = max(per_splat, before + _FALL * (per_splat - before))
        return needed <= self.capacity


@dataclass
class Rooms:
    """Capacities of the renderings in a context, in order."""

    rooms: list[Room] = field(default_factory=list)

    def suffice(self) -> bool:
        """Whether every rendering had enough capacity; one device-to-host synchronisation."""
        if not self.rooms:
            return True
        numbers = torch.stack([room.needed for room in self.rooms]).tolist()
        return all([room.expect(number) for room, number in zip(self.rooms, numbers, strict=True)])


_rooms: ContextVar[Rooms | None] = ContextVar("rooms", default=None)


@contextmanager
def defer_checks() -> Iterator[Rooms]:
    """Context in which renderings do not check their capacities: the caller must check
    :meth:`Rooms.suffice`."""
    rooms = Rooms()
    token = _rooms.set(rooms)
    try:
        yield rooms
    finally:
        _rooms.reset(token)


def repeat_until_sufficient(call: Callable[[], T]) -> T:
    """Return ``call()``, repeated until every rendering inside had enough capacity.

    Takes one device-to-host synchronisation per call, none without renderings. A repeated call has
    the capacity that the last one needed.

    Args:
        call: renders, any number of times, and may be called repeatedly. Inside :func:`defer_checks` it
            is called once and not checked.
    """
    if _rooms.get() is not None:
        return call()
    while True:
        with defer_checks() as rooms:
            result = call()
        if rooms.suffice():
            return result


def render_with_capacity(
    grid: Grid,
    splats: int,
    find: Callable[[int], tuple[T, Tensor]],
    draw: Callable[[T], Drawn],
) -> Drawn:
    """Find and render intersections with enough capacity.

    Args:
        grid: tiles of an image (rows, columns).
        splats: number of splats of all images together, at least 1.
        find: finds intersections, given a capacity; returns them and the number needed.
        draw: renders intersections.

    Returns:
        The last result of ``draw``. Inside :func:`defer_checks` it may lack splats: the caller checks
        the capacities.
    """
    rooms = _rooms.get()
    while True:
        capacity = bucket_size(math.ceil(_SPARE * splats * _expected.get(grid, _FIRST)) or 1)
        intersections, needed = find(capacity)
        room = Room(grid, splats, capacity, needed)
        number = Coming(needed) if rooms is None else None
        drawn = draw(intersections)
        if rooms is not None:
            rooms.rooms.append(room)
            return drawn
        if room.expect(number.read()):
            return drawn


class Coming:
    """Asynchronous copy of a scalar to the host, which waits for it only on reading.

    Args:
        value: a scalar on any device.
    """

    def __init__(self, value: Int[Tensor, ""]):
        self.value = value
        self.arrived = None
        if value.is_cuda:
            self.value = torch.empty((), dtype=value.dtype, pin_memory=True)
            self.value.copy_(value, non_blocking=True)
            self.arrived = torch.cuda.Event()
            self.arrived.record(torch.cuda.current_stream(value.device))

    def read(self) -> int:
        """Return the number; waits only for work that was queued before its copy."""
        if self.arrived is not None:
            self.arrived.synchronize()
        return int(self.value)
