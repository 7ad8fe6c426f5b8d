"""Progress of long tasks: a bar on a terminal, otherwise one line per minute."""

import datetime
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TypeVar

from rich.console import Console
from rich.progress import track as bar

T = TypeVar("T")

EVERY = 60.0  #: Seconds between two progress lines


def on_terminal() -> bool:
    """Whether standard output is a terminal."""
    return Console().is_terminal


class Lines:
    """Progress lines, appended to a file and printed.

    Args:
        log: File to append lines to; None: no file.
        every: Seconds between two lines.
        printed: Whether to print lines; False where a bar is shown.
    """

    def __init__(self, log: Path | None = None, every: float = EVERY, printed: bool = True) -> None:
        self.log = log
        self.every = every
        self.printed = printed
        self._next = time.monotonic()

    def is_due(self) -> bool:
        """Whether to write a line now: True at the first call, then once every ``every`` seconds."""
        now = time.monotonic()
        if now < self._next:
            return False
        self._next = now + self.every
        return True

    def write(self, text: str) -> None:
        """Write one line that starts with the time of day.

        Args:
            text: Line without its newline.
        """
        line = f"{datetime.datetime.now():%H:%M:%S} {text}"
        if self.printed:
            print(line, flush=True)
        if self.log is not None:
            with open(self.log, "a") as file:
                file.write(line + "\n")


def format_duration(seconds: float) -> str:
    """Format a duration, rounded to whole seconds, as ``h:mm:ss``, such as ``1:02:03``."""
    return str(datetime.timedelta(seconds=round(seconds)))


def track(items: Iterable[T], text: str, every: float = EVERY) -> Iterator[T]:
    """Yield items while reporting progress: a bar on a terminal, otherwise a line with the count.

    Args:
        items: Any iterable; the total is reported if it has a length.
        text: Description of the task.
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
        if lines.is_due() and done:
            lines.write(f"{text}: {done}{total}, {format_duration(time.monotonic() - started)}")
        yield item
