"""How far a long task is: a bar on a terminal, a line a minute where there is none, as in a batch job."""

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
    """Whether somebody watches: a bar moves instead of lines."""
    return Console().is_terminal


class Lines:
    """Prints a line every so many seconds, unless not ``printed``, and appends it to the file ``log``."""

    def __init__(self, log: Path | None = None, printed: bool = True, every: float = EVERY) -> None:
        self.log, self.printed, self.every = log, printed, every
        self._next = time.monotonic()

    def due(self) -> bool:
        """Whether it is time for a line; the first is due at once, and then one each ``every`` seconds."""
        now = time.monotonic()
        if now < self._next:
            return False
        self._next = now + self.every
        return True

    def say(self, text: str) -> None:
        """One line, with the time of the day."""
        line = f"{datetime.datetime.now():%H:%M:%S} {text}"
        if self.printed:
            print(line, flush=True)
        if self.log is not None:
            with open(self.log, "a") as file:
                file.write(line + "\n")


def clock(seconds: float) -> str:
    """``1:02:03``."""
    return str(datetime.timedelta(seconds=round(seconds)))


def track(items: Iterable[T], text: str, every: float = EVERY) -> Iterator[T]:
    """``items``, with a bar or, each ``every`` seconds, with a line that says how many of them are done."""
    if on_terminal():
        yield from bar(items, text, transient=True)
        return
    total = f" of {len(items)}" if hasattr(items, "__len__") else ""
    lines, started = Lines(every=every), time.monotonic()
    for done, item in enumerate(items):
        if lines.due() and done:
            lines.say(f"{text}: {done}{total}, {clock(time.monotonic() - started)}")
        yield item
