"""One run on disk: whether it is done, who works on it, when it was worked on.

``metrics.json`` is written last and renamed into place: a run that has it is done. ``.lock`` is locked by
the process that works on the run (a POSIX record lock: the kernel frees it however the process ends, forked
children do not inherit it, and NFS keeps it among machines). ``sessions.jsonl`` gets one line when
somebody starts to work on the run and one when that ends; a killed process leaves only the first.
"""

import contextlib
import datetime
import errno
import fcntl
import json
import os
import socket
import time
from collections.abc import Iterator
from enum import Enum
from pathlib import Path
from typing import Any

from ghgs_lit.errors import InputError
from ghgs_lit.runs.results import read_results

# Directories whose lock this process holds: closing a second handle of a lock file would free it.
_HELD: set[Path] = set()


class State(str, Enum):
    """What there is of a run."""

    DONE = "done"
    RUNNING = "running"
    PARTIAL = "partial"  # goes on from its last checkpoint
    FAILED = "failed"  # will be tried again
    MISSING = "missing"


class Run:
    """The run in ``directory``, which need not exist."""

    def __init__(self, directory: Path) -> None:
        self.directory = Path(directory).resolve()

    @property
    def results(self) -> dict[str, Any] | None:
        """The content of a whole ``metrics.json``; None where there is none."""
        path = self.directory / "metrics.json"
        try:
            return read_results(path) if path.is_file() else None
        except InputError:
            return None

    @property
    def done(self) -> bool:
        return self.results is not None

    @property
    def metric(self) -> float | None:
        """Mean PSNR of the first protocol, the number that a sweep compares."""
        results = self.results
        return None if results is None else results["summary"][0]["psnr"]

    @property
    def checkpoint(self) -> Path | None:
        """Where a run that was cut off goes on from."""
        path = self.directory / "checkpoints" / "last.ckpt"
        return path if path.is_file() else None

    @property
    def state(self) -> State:
        if self.done:
            return State.DONE
        if self._locked():
            return State.RUNNING
        sessions = self.sessions()
        if sessions and sessions[-1].get("outcome") == "failed":
            return State.FAILED
        return State.PARTIAL if self.checkpoint else State.MISSING

    @property
    def owner(self) -> str:
        """Who locked the run last, for messages."""
        try:
            return (self.directory / ".lock").read_text().strip() or "another process"
        except OSError:
            return "another process"

    def sessions(self) -> list[dict[str, Any]]:
        """Every time somebody worked on the run; ``ended`` and ``outcome`` are missing after a kill."""
        try:
            lines = (self.directory / "sessions.jsonl").read_text().splitlines()
        except FileNotFoundError:
            return []
        found: list[dict[str, Any]] = []
        for line in lines:
            try:
                entry = json.loads(line)
            except json.JSONDecodeError:  # the process died while it wrote this line
                continue
            if "started" in entry:
                found.append(entry)
            elif found:
                found[-1] |= entry
        return found

    @contextlib.contextmanager
    def session(self, **facts: Any) -> Iterator[dict[str, Any]]:
        """Note that this process works on the run, and how that ends; what is put into the dict, too."""
        self._note({"started": _now(), "host": socket.gethostname(), "pid": os.getpid(), **facts})
        notes: dict[str, Any] = {}
        try:
            yield notes
        except BaseException as error:
            outcome = "failed" if isinstance(error, Exception) else "interrupted"
            self._note({"ended": _now(), "outcome": outcome, "error": str(error), **notes})
            raise
        self._note({"ended": _now(), "outcome": "done", **notes})

    def _note(self, entry: dict[str, Any]) -> None:
        path = self.directory / "sessions.jsonl"
        cut_off = path.is_file() and not path.read_bytes().endswith(b"\n") and path.stat().st_size > 0
        with open(path, "a") as file:
            file.write(("\n" if cut_off else "") + json.dumps(entry) + "\n")

    @contextlib.contextmanager
    def claim(self, wait: bool = False) -> Iterator[bool]:
        """Whether this process, and no other, may work on the run inside the ``with``.

        ``wait`` until whoever has it lets go or dies.
        """
        if self.directory in _HELD:
            yield False
            return
        self.directory.mkdir(parents=True, exist_ok=True)
        handle = os.open(self.directory / ".lock", os.O_RDWR | os.O_CREAT, 0o664)
        try:
            mine = _lock(handle, fcntl.LOCK_EX, wait, self.directory)
            if not mine:  # unless somebody only looks whether the run is locked
                time.sleep(0.05)
                mine = _lock(handle, fcntl.LOCK_EX, wait, self.directory)
            if mine:
                _HELD.add(self.directory)
                os.ftruncate(handle, 0)
                os.write(handle, f"process {os.getpid()} on {socket.gethostname()}\n".encode())
            yield mine
        finally:
            os.close(handle)
            _HELD.discard(self.directory)

    def _locked(self) -> bool:
        path = self.directory / ".lock"
        if self.directory in _HELD:
            return True
        if not path.exists():
            return False
        handle = os.open(path, os.O_RDONLY)
        try:
            return not _lock(handle, fcntl.LOCK_SH, False, self.directory)
        finally:
            os.close(handle)


def _lock(handle: int, kind: int, wait: bool, directory: Path) -> bool:
    try:
        fcntl.lockf(handle, kind | (0 if wait else fcntl.LOCK_NB))
    except OSError as error:
        if error.errno in (errno.EACCES, errno.EAGAIN):
            return False
        if error.errno in (errno.ENOLCK, errno.ENOTSUP, errno.ENOSYS):
            raise InputError(f"{directory}: expected a file system with locks; found {error}") from None
        raise
    return True


def _now() -> str:
    return datetime.datetime.now(datetime.timezone.utc).isoformat(timespec="milliseconds")
