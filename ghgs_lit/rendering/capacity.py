"""How many intersections of splats with tiles there is room for,
and what happens where there are more.

Reading the number of intersections would be a device-to-host synchronisation before anything is
rendered. So each rendering gets the room that similar ones needed, and some more; the number that it
really needed is read later: while the GPU renders, or after several renderings (:func:`settled`). Where
the room was too small the rendering is repeated with enough: an image never lacks splats."""

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
#: Tiles that a splat is expected to touch at first, and what is added to the most that was seen.
_FIRST = 4.0
_SPARE = 1.25
#: Share of a difference by which an expectation falls if less was needed; it rises at once.
_FALL = 0.1

#: Tiles of an image (rows, columns): what is expected for them depends on nothing else
#: that is known.
Grid = tuple[int, int]
_expected: dict[Grid, float] = {}


@dataclass(frozen=True)
class Room:
    """Room that a rendering had, and the number that it ``needed``, on its device.

    Attributes:
        grid: tiles of an image (rows, columns).
        splats: number of all images together.
        capacity: number of intersections that there was room for.
        needed: number of intersections that there were, a scalar on the device of the rendering.
    """

    grid: Grid
    splats: int
    capacity: int
    needed: Int[Tensor, ""]

    def expect(self, needed: int) -> bool:
        """Note what was needed; later renderings of the same grid expect it.

        Args:
            needed: number of intersections, as read by the host.

        Returns:
            Whether the room sufficed.
        """
        per_splat = needed / self.splats
        before = _expected.get(self.grid, 0.0)
        _expected[self.grid] = max(per_splat, before + _FALL * (per_splat - before))
        return needed <= self.capacity


@dataclass
class Rooms:
    """Rooms of the renderings in a context, in their order."""

    rooms: list[Room] = field(default_factory=list)

    def suffice(self) -> bool:
        """Whether every rendering had enough room; the host waits once."""
        if not self.rooms:
            return True
        numbers = torch.stack([room.needed for room in self.rooms]).tolist()
        return all([room.expect(number) for room, number in zip(self.rooms, numbers, strict=True)])


_rooms: ContextVar[Rooms | None] = ContextVar("rooms", default=None)


@contextmanager
def deferred() -> Iterator[Rooms]:
    """Inside, renderings do not check their rooms:
    who opens this must see whether they ``suffice``."""
    rooms = Rooms()
    token = _rooms.set(rooms)
    try:
        yield rooms
    finally:
        _rooms.reset(token)


def settled(call: Callable[[], T]) -> T:
    """The result of ``call``, repeated where a rendering inside had too little room.

    The host waits once for all renderings inside, and not at all without any. A repeated call has
    enough room for what was seen.

    Args:
        call: anything that renders; it may be called several times. Inside :func:`deferred` it is
            called once and not checked.
    """
    if _rooms.get() is not None:
        return call()
    while True:
        with deferred() as rooms:
            result = call()
        if rooms.suffice():
            return result


def with_room(
    grid: Grid,
    splats: int,
    find: Callable[[int], tuple[T, Tensor]],
    draw: Callable[[T], Drawn],
) -> Drawn:
    """What is drawn with enough room.

    Args:
        grid: tiles of an image (rows, columns).
        splats: number of all images together, at least 1.
        find: finds intersections in a capacity, and gives them and the number that is needed.
        draw: draws intersections.

    Returns:
        What ``draw`` returned last. Inside :func:`deferred` it may lack splats: the caller
        checks the rooms.
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
    """A number on its way to the host, which can go on until it reads it.

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
        """The number; waits for what the device was asked before it was made, and no longer."""
        if self.arrived is not None:
            self.arrived.synchronize()
        return int(self.value)
