"""A run on disk: whose configuration it has, how it goes on, the process that works on it,
and its sessions.

``run.json`` marks a folder as a run's, with the hash of its configuration; only in such a folder, and
only by the process that has locked ``.lock``, anything is deleted. A run is done when it has the
``metrics.json`` of its configuration, which is written last. ``sessions.jsonl`` has a line for the
start of each process and one for its end, which a killed process lacks. No file names the folder,
so that a run can be moved.
"""

import contextlib
import datetime
import json
import os
import re
import shutil
import socket
import uuid
from collections.abc import Iterable, Iterator
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import BaseModel, ConfigDict

from ghgs_lit.config.keys import MAY_CHANGE_ON_RESUME, lookup
from ghgs_lit.config.run import Run
from ghgs_lit.errors import InputError, require
from ghgs_lit.files import (
    append_line,
    is_locked,
    lock,
    lock_owner,
    require_no_links,
    resolved,
    write_text_atomically,
)
from ghgs_lit.parsing import read_json, read_lines_of_json, read_yaml
from ghgs_lit.runs.processes import is_queued_again, launch, slurm_job
from ghgs_lit.runs.results import config_hash, differences, read_results, validated

if TYPE_CHECKING:
    from ghgs_lit.cli.verb import Training

AUTO = "auto"  #: Value of ``resume``: as the directory stands
MARKER = "run.json"
#: What training writes into a run's directory, apart from checkpoints of other names and Hydra's logs,
#: and a new run deletes; other files in these folders are a user's.
_FILES = (
    "checkpoints/frozen-*.pt",
    "csv/metrics.csv",
    "faults/step_*.pt",
    "init_from.txt",
    "metrics.csv",
    "metrics.json",
    "pictures/model_v*.png",
    "pictures/step_*/*.png",
    "tensorboard/events.out.tfevents.*",
)
WRITTEN = tuple(dict.fromkeys(pattern.partition("/")[0] for pattern in _FILES))  #: Names in the directory
_CURVES = "tb"  #: Folder of a sweep with TensorBoard's files of its runs
SESSIONS = "sessions.jsonl"
PLAN = "multirun.yaml"  #: Configuration of a sweep's last command, in the sweep's folder


class Identity(BaseModel):
    """Content of ``run.json``.

    Attributes:
        id: of the run, wherever it is moved, also for loggers elsewhere.
        config_hash: of the configuration.
        settings_hash: of the configuration without what may change while it trains.
        resume: value of ``resume`` that it began with.
        job: of SLURM, which worked on it last.
    """

    model_config = ConfigDict(strict=True)
    id: str
    config_hash: str
    settings_hash: str
    resume: str | None
    job: str | None


#: File of a run of a grid with the overrides that distinguish it.
SWEPT = "swept.json"


def runs_in_order(sweep: Path) -> list[str]:
    """Names of the folders of a sweep's runs, those of its last command first.

    Args:
        sweep: Directory of the sweep.

    Returns:
        Names in the order in which the commands list them; empty where no file does.
    """
    with contextlib.suppress(InputError, OSError):
        names = lookup(read_yaml(sweep / PLAN), "runs")
        if isinstance(names, list):
            return list(map(str, names))
    return []


class State(StrEnum):
    """State of a run."""

    DONE = "done"
    RUNNING = "running"
    PARTIAL = "partial"  # resumes from its last checkpoint
    FAILED = "failed"  # is started again
    MISSING = "missing"


class RunDirectory:
    """Directory of a run; it need not exist.

    Args:
        path: of the directory.
        config_hash: results of another configuration are none of this run; None: whatever its
            configuration is.
    """

    def __init__(self, path: Path, config_hash: str | None = None) -> None:
        self.path = resolved(path)
        self.config_hash = config_hash
        self._lock = self.path / ".lock"
        self._is_mine = False

    def of(self, run: Run) -> "RunDirectory":
        """The directory as that of a run.

        Args:
            run: Its configuration.

        Returns:
            A directory whose results count only if they are of that configuration.
        """
        return RunDirectory(self.path, config_hash(run.plain))

    @property
    def results(self) -> dict[str, Any] | None:
        """Content of ``metrics.json``; None if it is missing,
        unreadable or of another configuration."""
        path = self.path / "metrics.json"
        try:
            results = read_results(path) if path.is_file() else None
        except InputError:
            return None
        if results is None or self.config_hash is None:
            return results
        # A verb may complete the configuration of its command, whose hash is that of the run.
        hashes = [lookup(results["provenance"], key) for key in ("config_hash", "run.config_hash")]
        return results if self.config_hash in hashes else None

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
        """Overrides that distinguish a run of a grid from the others; none for a single run."""
        path = self.path / SWEPT
        texts = read_json(path) if path.is_file() else []
        fits = isinstance(texts, list) and all(isinstance(text, str) and text.isprintable() for text in texts)
        require(fits, str(path), "a list of overrides", texts)
        return texts

    @property
    def title(self) -> str:
        """:attr:`swept` as the name of a folder, without the groups of keys; of a long one the end."""
        changes = (re.sub(r"^[^=]*\.", "", change) for change in self.swept)
        return ",".join(changes).replace(os.sep, "_")[-200:].lstrip(".")

    @property
    def curves(self) -> Path:
        """Folder of TensorBoard's files, by which TensorBoard names the run: for a run of a grid
        in the sweep's folder, called :attr:`title`; ``.run`` in it holds the run's id."""
        if not (self.title and (self.path.parent / PLAN).is_file()):
            return self.path / "tensorboard"
        folder = self.path.parent / _CURVES / self.title
        marker = self.marker
        is_free = marker is None or _owner_of(folder) in (None, marker.id)
        return folder if is_free else folder.with_name(f"{self.title},run={marker.id}")

    @property
    def owner(self) -> str:
        """Process that worked on the run last, for messages."""
        return lock_owner(self._lock)

    @contextlib.contextmanager
    def claim(self, wait: bool = False) -> Iterator[bool]:
        """Lock the run for this process (:func:`ghgs_lit.files.lock`).

        Args:
            wait: Wait for a process that has locked it.

        Yields:
            Whether the run is locked for this process.
        """
        with lock(self._lock, wait) as self._is_mine:
            try:
                yield self._is_mine
            finally:
                self._is_mine = False

    @property
    def marker(self) -> Identity | None:
        """Content of ``run.json``; None: the folder is no run's.

        Raises:
            InputError: It is another file.
        """
        path = self.path / MARKER
        if not path.is_file():
            return None
        return validated(Identity, read_json(path, "a run's identity"), str(path))

    def start(self, run: "Training") -> str | None:
        """The checkpoint that a run starts from in this directory. Nothing is written.

        Args:
            run: Its configuration; in a new directory the keys of its verb alone are read.

        Returns:
            Path of the checkpoint; None: from the first step.

        Raises:
            InputError: What another run wrote is there, or files of somebody else.
        """
        require_no_links(self.path, WRITTEN)
        if self.curves.parent != self.path:
            require_no_links(self.path.parent, (_CURVES, str(self.curves.relative_to(self.path.parent))))
        resume = run.resume
        given = None if resume == AUTO else resume
        if self._has(resume) or self.goes_on(run):
            checkpoint = resume if self._has(resume) else self.checkpoint
            return str(checkpoint) if checkpoint is not None else given
        owned = self.marker is not None
        there = self._there(*WRITTEN) if owned else self._there(*WRITTEN, SESSIONS)
        if not there:
            return given
        if not (run.overwrite and owned):
            raise InputError(f"{self.path}: {self._refusal(run, there[0], owned)}")
        for key, source in (("init_from", getattr(run, "init_from", None)), ("resume", resume)):
            require(not self._has(source), key, "a file outside the run that overwrite=true deletes", source)
        return given

    def goes_on(self, run: "Training") -> bool:
        """Whether the directory has the run that the same command began; only the length of a run
        that is not complete, and what is measured after it, may differ.

        Args:
            run: Configuration of the command.

        Returns:
            Whether the run goes on.
        """
        marker = self.marker
        if marker is None or run.resume is None or marker.resume != run.resume:
            return False
        if run.overwrite and not (is_queued_again() and marker.job == slurm_job()):
            return False
        if marker.config_hash == config_hash(run.plain):
            return True
        is_complete = RunDirectory(self.path).done
        return not is_complete and marker.settings_hash == config_hash(run.plain, MAY_CHANGE_ON_RESUME)

    def _there(self, *names: str) -> list[str]:
        return [name for name in names if os.path.lexists(self.path / name)]

    def _has(self, path: str | None) -> bool:
        """Whether ``path`` is a file of this run."""
        return path not in (None, AUTO) and resolved(path).is_relative_to(self.path)

    def _refusal(self, run: Run, there: str, owned: bool) -> str:
        ways = "hydra.run.dir or hydra.sweep.subdir name another"
        if self.checkpoint is not None:
            ways += f", resume={self.checkpoint} goes on with its weights"
        if not owned:
            return f"expected a directory without a run or other files of these names; found {there} ({ways})"
        with contextlib.suppress(InputError, FileNotFoundError):
            changed = differences(read_yaml(self.path / "config.yaml"), run.plain)
            if changed:
                there = f"{there} of another configuration: {', '.join(changed[:3])}"
        return (
            f"expected a directory without a run; found {there} ({ways}, overwrite=true deletes a single run)"
        )

    def begin(self, run: "Training") -> "Training":
        """Make the directory that of a run. Where there is no checkpoint to start from, what was
        written is trained again, and deleted. Call it where the run is claimed.

        Args:
            run: Its configuration.

        Returns:
            The run with the checkpoint to start from as ``resume``.

        Raises:
            InputError: As for :meth:`start`.
        """
        start = self.start(run)
        marker = self.marker
        is_same = self.goes_on(run)
        if not self._has(start):
            self._clear(run, with_sessions=not is_same)
        known = marker if is_same or self._has(start) else None
        identity = Identity(
            id=known.id if known else uuid.uuid4().hex[:8],
            config_hash=config_hash(run.plain),
            settings_hash=config_hash(run.plain, MAY_CHANGE_ON_RESUME),
            resume=known.resume if known else run.resume,
            job=slurm_job(),
        )
        write_text_atomically(self.path / MARKER, identity.model_dump_json(indent=1) + "\n")
        if self.curves.parent != self.path:
            write_text_atomically(self.curves / ".run", identity.id)
        return run.replace(resume=start)

    def _clear(self, run: "Training", with_sessions: bool) -> None:
        """Delete what training wrote; only in a run's folder that this process has claimed."""
        options = run.plain.get("callbacks", {}).values()
        names = (re.sub(r"\{.*?\}", "*", each["filename"]) for each in options if each and "filename" in each)
        patterns = [*_FILES, *(f"checkpoints/{name}.ckpt" for name in names), *[SESSIONS] * with_sessions]
        paths = [path for pattern in patterns for path in self.path.glob(pattern)]
        marker = self.marker
        if marker is not None and _owner_of(self.curves) == marker.id:
            paths += [*self.curves.glob("events.out.tfevents.*"), self.curves / ".run"]
        if paths and not (self._is_mine and marker is not None):
            raise RuntimeError(f"{self.path}: files are deleted in a run that this process has claimed only")
        for path in paths:
            path.unlink()
        for folder in {path.parent for path in paths} - {self.path}:
            with contextlib.suppress(OSError):  # a user's files are in it
                folder.rmdir()

    def discard(self, others: Iterable[str], since: float) -> None:
        """Remove a directory in which nothing was begun: it holds only files of a start, those of a
        run and ``others``, and no process works in it.

        Args:
            others: Names of further files that may be there.
            since: Time of the start in seconds; older files are not removed.
        """
        known = {".lock", MARKER, "config.yaml", SESSIONS, *others}

        def is_unused() -> bool:
            paths = list(self.path.glob("*"))
            if not paths:  # made for this start, if it is as new
                return self.path.is_dir() and self.path.stat().st_mtime >= since
            return all(p.name in known and p.lstat().st_mtime >= since for p in paths)

        if self.path == Path.cwd() or not is_unused():
            return
        with self.claim() as mine:
            if mine and is_unused():
                shutil.rmtree(self.path, ignore_errors=True)

    def sessions(self) -> list[dict[str, Any]]:
        """An entry for each process that worked on the run; a killed one has no ``outcome``."""
        path = self.path / SESSIONS
        sessions: list[dict[str, Any]] = []
        for entry in read_lines_of_json(path) if path.exists() else ():
            if "started" in entry:
                sessions.append(entry)
            elif sessions:
                sessions[-1] |= entry
        return sessions

    @contextlib.contextmanager
    def session(self, resumed: str | None = None) -> Iterator[dict[str, Any]]:
        """Log start and end of this process in ``sessions.jsonl``.

        Args:
            resumed: Checkpoint that it resumed; logged relative to the run if it is its own.

        Yields:
            A dict for numbers such as steps and seconds, which are logged at the end.
        """
        if self._has(resumed):
            resumed = str(resolved(resumed).relative_to(self.path))
        process = {"host": socket.gethostname(), "pid": os.getpid(), "launch": launch()}
        self._log("started", **process, resumed=resumed)
        stats: dict[str, Any] = {}
        try:
            yield stats
        except BaseException as error:
            outcome = "failed" if isinstance(error, Exception) else "interrupted"
            self._log("ended", outcome=outcome, error=str(error), **stats)
            raise
        self._log("ended", outcome="done", **stats)

    def session_beside(self) -> dict[str, Any] | None:
        """The present session of the first of the processes that were started together with this
        one, with the path of the checkpoint that it ``resumed``; None: there is none yet."""
        last = (self.sessions() or [{}])[-1]
        if last.get("launch") != launch() or "outcome" in last or not is_locked(self._lock):
            return None
        resumed = last["resumed"]
        return {**last, "resumed": resumed and str(self.path / resumed)}

    def _log(self, moment: str, **facts: Any) -> None:
        now = datetime.datetime.now(datetime.UTC).isoformat(timespec="milliseconds")
        append_line(self.path / SESSIONS, json.dumps({moment: now, **facts}))


def _owner_of(curves: Path) -> str | None:
    path = curves / ".run"
    return path.read_text(errors="replace") if path.is_file() else None


def begun_by_job(folder: Path, pattern: str) -> list[RunDirectory]:
    """Runs that the present job of SLURM has worked on.

    Args:
        folder: Below which they are.
        pattern: Of their ``run.json`` below the folder.

    Returns:
        The runs; none outside of SLURM.
    """
    runs = [RunDirectory(path.parent) for path in folder.glob(pattern)]
    return [run for run in runs if slurm_job() is not None and run.marker.job == slurm_job()]
