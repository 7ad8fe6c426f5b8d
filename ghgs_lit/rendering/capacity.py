"""Capacity of the buffers for intersections of splats with tiles.

Reading the number of intersections would synchronise device and host, which a CUDA graph cannot capture.
So each rendering gets the capacity that similar ones needed, with a margin; the number that it really
needed is read after several renderings (:func:`repeat_until_sufficient`). If a capacity was too small,
the renderings are repeated with enough: an image never lacks splats."""

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


@dataclass
class Rooms:
    """Capacities of the renderings in a context, in order."""

    rooms: list[Room] = field(default_factory=list)

    def suffice(self) -> bool:
        """Whether every rendering had enough capacity; one device-to-host synchronisation.

        Updates the estimates for later renderings.
        """
        if not self.rooms:
            return True
        numbers = torch.stack([room.needed for room in self.rooms]).tolist()
        for room, needed in zip(self.rooms, numbers, strict=True):
            per_splat = needed / room.splats
            before = _expected.get(room.grid, 0.0)
            _expected[room.grid] = max(per_splat, before + _FALL * (per_splat - before))
        return all(needed <= room.capacity for room, needed in zip(self.rooms, numbers, strict=True))


#: Capacities of the current context; None outside of :func:`defer_checks`.
deferred: ContextVar[Rooms | None] = ContextVar("deferred", default=None)


@contextmanager
def defer_checks() -> Iterator[Rooms]:
    """Context in which renderings do not check their capacities: the caller must check
    :meth:`Rooms.suffice`."""
    rooms = Rooms()
    token = deferred.set(rooms)
    try:
        yield rooms
    finally:
        deferred.reset(token)


def repeat_until_sufficient(call: Callable[[], T]) -> T:
    """Return ``call()``, repeated until every rendering inside had enough capacity.

    Takes one device-to-host synchronisation per call, none without renderings. A repeated call has
    the capacity that the last one needed.

    Args:
        call: renders, any number of times, and may be called repeatedly. Inside :func:`defer_checks` it
            is called once and not checked.
    """
    if deferred.get() is not None:
        return call()
    while True:
        with defer_checks() as rooms:
            result = call()
        if rooms.suffice():
            return result


def expected_capacity(grid: Grid, splats: int) -> int:
    """Capacity for a rendering.

    Args:
        grid: tiles of an image (rows, columns).
        splats: number of splats of all images together, at least 1.
    """
    return bucket_size(math.ceil(_SPARE * splats * _expected.get(grid, _FIRST)) or 1)
