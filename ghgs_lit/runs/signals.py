"""Ctrl-C and SIGTERM: who is asked to stop ends with exit code 130 or 143, and nothing follows."""

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from types import FrameType
from typing import Any

STOP = (signal.SIGINT, signal.SIGTERM)


class Interrupted(SystemExit):
    """This process was asked to stop; the exit code is 128 and the signal's number. A ``SystemExit``, because
    Hydra takes any ``Exception`` for one failed job and starts the next one. ``number``: of the signal.
    ``explained``: whether a line that says how to go on is printed already."""

    def __init__(self, number: int) -> None:
        super().__init__(128 + number)
        self.number = number
        self.explained = False


class _Handler:
    """Calls ``act(number)`` in the process that made it, and not in workers that are forked later."""

    def __init__(self, act: Callable[[int], Any]) -> None:
        self.act, self.process = act, os.getpid()

    def __call__(self, number: int, frame: FrameType | None) -> None:
        if os.getpid() == self.process:
            self.act(number)
        elif number == signal.SIGTERM:  # that is how a parent ends its workers
            signal.signal(number, signal.SIG_DFL)
            os.kill(os.getpid(), number)


def interrupt(number: int) -> None:
    """Stop here."""
    raise Interrupted(number)


def handlers() -> dict[int, Any]:
    """The present handlers of both signals; those that Python cannot know are left out, and alone."""
    found = {number: signal.getsignal(number) for number in STOP}
    return {number: handler for number, handler in found.items() if handler is not None}


def handle(act: Callable[[int], Any], before: Mapping[int, Any]) -> None:
    """Let ``act(number)`` handle the signals that nobody else handles. submitit and ``nohup`` have handlers
    of their own, which stay: under submitit SIGTERM does not end a job. ``act``: called with the signal's
    number. ``before``: the handlers to judge by, and to return to where they are somebody else's."""
    if threading.current_thread() is not threading.main_thread():
        return  # signals belong to the main thread
    for number, handler in before.items():
        free = handler in (signal.SIG_DFL, signal.default_int_handler) or isinstance(handler, _Handler)
        signal.signal(number, _Handler(act) if free else handler)


@contextlib.contextmanager
def interruptible() -> Iterator[None]:
    """Raise :class:`Interrupted` on Ctrl-C and SIGTERM, where nobody else handles them."""
    before = handlers()
    handle(interrupt, before)
    try:
        yield
    finally:
        if threading.current_thread() is threading.main_thread():
            for number, handler in before.items():
                signal.signal(number, handler)


def print_how_to_go_on(stop: Interrupted, what: str, change: str) -> None:
    """One line on stderr: what was stopped, and what to add to the same command to go on with it."""
    stop.explained = True
    name = signal.Signals(stop.number).name
    print(f"ghgs: {what} was interrupted ({name}); to go on, the same command with {change}", file=sys.stderr)
