"""Progress of long tasks: a bar on a terminal, else a line every minute."""

import datetime
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TypeVar

from rich.console import Console
from rich.progress import track as bar

T = TypeVar("T")

EVERY = 60.0  #: Seconds between two lines


def on_terminal() -> bool:
    """Whether the output is a terminal."""
    return Console().is_terminal


class Lines:
    """Progress lines, appended to a file and printed (unless there is a bar).

    Args:
        log: file that lines are appended to; None: none.
        every: seconds between two lines.
        printed: whether lines are printed.
    """

    def __init__(self, log: Path | None = None, every: float = EVERY, printed: bool = True) -> None:
        self.log = log
        self.every = every
        self.printed = printed
        self._next = time.monotonic()

    def due(self) -> bool:
        """Whether a line is due: at the first call, then after ``every`` seconds each."""
        now = time.monotonic()
        if now < self._next:
            return False
        self._next = now + self.every
        return True

    def write(self, text: str) -> None:
        """Write one line with the time of day.

        Args:
            text: Without the end of the line.
        """
        line = f"{datetime.datetime.now():%H:%M:%S} {text}"
        if self.printed:
            print(line, flush=True)
        if self.log is not None:
            with open(self.log, "a") as file:
                file.write(line + "\n")


def clock(seconds: float) -> str:
    """A duration for people.

    Args:
        seconds: Rounded to whole ones.

    Returns:
        Text such as ``1:02:03``.
    """
    return str(datetime.timedelta(seconds=round(seconds)))


def track(items: Iterable[T], text: str, every: float = EVERY) -> Iterator[T]:
    """Yield items with a bar on a terminal, elsewhere with a line now and then that
    counts those done.

    Args:
        items: Whatever is worked on.
        text: What is done with them.
        every: Seconds between two lines.

    Yields:
        The items.
    """
    if on_terminal():
        yield from bar(items, text, transient=True)
        return
    total = f" of {len(items)}" if hasattr(items, "__len__") else ""
    lines = Lines(every=every)
    started = time.monotonic()
    for done, item in enumerate(items):
        if lines.due() and done:
            lines.write(f"{text}: {done}{total}, {clock(time.monotonic() - started)}")
        yield item
