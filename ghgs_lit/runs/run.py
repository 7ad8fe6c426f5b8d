"""A run on disk: its state, the process that works on it, and its sessions.

A run is done when it has ``metrics.json``, which is written last. The process that works on it locks
``.lock``. ``sessions.jsonl`` has a line for the start of each process and one for its end, which a killed
process lacks.
"""

import contextlib
import datetime
import json
import os
import socket
from collections.abc import Iterator
from enum import StrEnum
from pathlib import Path
from typing import Any

from ghgs_lit.errors import InputError
from ghgs_lit.files import append_line, is_locked, lock, lock_owner
from ghgs_lit.readers import read_json, read_lines_of_json
from ghgs_lit.runs.results import read_results

#: File of a run of a grid that says what sets it apart.
SWEPT = "swept.json"


class State(StrEnum):
    """State of a run."""

    DONE = "done"
    RUNNING = "running"
    PARTIAL = "partial"  # resumes from its last checkpoint
    FAILED = "failed"  # is started again
    MISSING = "missing"


class RunDirectory:
    """Directory of a run; it need not exist."""

    def __init__(self, path: Path) -> None:
        self.path = Path(path).resolve()
        self._lock = self.path / ".lock"

    @property
    def results(self) -> dict[str, Any] | None:
        """Content of ``metrics.json``; None if it is missing or unreadable."""
        path = self.path / "metrics.json"
        try:
            return read_results(path) if path.is_file() else None
        except InputError:
            return None

    @property
    def done(self) -> bool:
        return self.results is not None

    @property
    def metric(self) -> float | None:
        """Mean PSNR of the first protocol, by which a sweep compares its runs."""
        results = self.results
        return None if results is None else results["summary"][0].get("psnr")

    @property
    def checkpoint(self) -> Path | None:
        """Checkpoint that an interrupted run resumes from."""
        path = self.path / "checkpoints" / "last.ckpt"
        return path if path.is_file() else None

    @property
    def state(self) -> State:
        if self.done:
            return State.DONE
        if is_locked(self._lock):
            return State.RUNNING
        sessions = self.sessions()
        if sessions and sessions[-1].get("outcome") == "failed":
            return State.FAILED
        return State.PARTIAL if self.checkpoint else State.MISSING

    @property
    def swept(self) -> list[str]:
        """Overrides that set a run of a grid apart from the others; none for a run of its own."""
        path = self.path / SWEPT
        return read_json(path) if path.is_file() else []

    @property
    def title(self) -> str:
        """:attr:`swept` as the name of a folder; of a long one the end."""
        return ",".join(self.swept).replace(os.sep, "_")[-200:]

    @property
    def owner(self) -> str:
        """Process that worked on the run last, for messages."""
        return lock_owner(self._lock)

    def claim(self, wait: bool = False) -> contextlib.AbstractContextManager[bool]:
        """Lock the run for this process; yields whether that succeeded (:func:`ghgs_lit.files.lock`)."""
        return lock(self._lock, wait)

    def sessions(self) -> list[dict[str, Any]]:
        """An entry for each process that worked on the run; a killed one has no ``outcome``."""
        path = self.path / "sessions.jsonl"
        found: list[dict[str, Any]] = []
        for entry in read_lines_of_json(path) if path.exists() else ():
            if "started" in entry:
                found.append(entry)
            elif found:
                found[-1] |= entry
        return found

    @contextlib.contextmanager
    def session(self, **facts: Any) -> Iterator[dict[str, Any]]:
        """Log start and end of this process in ``sessions.jsonl``. Yields a dict for numbers such as steps
        and seconds, which are logged at the end."""
        self._log({"started": _now(), "host": socket.gethostname(), "pid": os.getpid(), **facts})
        stats: dict[str, Any] = {}
        try:
            yield stats
        except BaseException as error:
            outcome = "failed" if isinstance(error, Exception) else "interrupted"
            self._log({"ended": _now(), "outcome": outcome, "error": str(error), **stats})
            raise
        self._log({"ended": _now(), "outcome": "done", **stats})

    def _log(self, entry: dict[str, Any]) -> None:
        append_line(self.path / "sessions.jsonl", json.dumps(entry))


def _now() -> str:
    return datetime.datetime.now(datetime.UTC).isoformat(timespec="milliseconds")
