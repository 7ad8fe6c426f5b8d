"""A run on disk: its identity, how it resumes, the process that holds it, and its sessions.

``run.json`` marks a folder as a run and contains the hash of its configuration and one session for each
process that worked on it. It is written, and files are deleted, only by the process that holds the lock
``.lock``. A run is done when ``metrics.json`` of its configuration exists, which is written last. No file
contains the path of the folder, so that a run can be moved.
"""

import contextlib
import datetime
import os
import re
import socket
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict

from ghgs_lit.config.keys import lookup
from ghgs_lit.config.run import Run
from ghgs_lit.errors import InputError, require
from ghgs_lit.files import (
    is_locked,
    lock,
    lock_owner,
    require_no_links,
    resolve_path,
    write_text_atomically,
)
from ghgs_lit.parsing import read_json, read_yaml
from ghgs_lit.runs.processes import is_queued_again, slurm_job
from ghgs_lit.runs.results import config_hash, differences, read_results, validate

AUTO = "auto"  #: Value of ``resume``: continue the run in the directory, if any
MARKER = "run.json"
PLAN = "multirun.yaml"  #: Configuration of a sweep's last command, in the sweep's folder
#: TensorBoard's files; in a sweep they are in a folder named after overrides.
CURVES = ("tensorboard/events.out.tfevents.*", "tensorboard/*=*/events.out.tfevents.*")
#: Files that training writes into a run's directory and that a new run deletes, apart from checkpoints of
#: other names and Hydra's logs; other files in these folders belong to the user.
_FILES = (
    "checkpoints/frozen-*.pt",
    "csv/metrics.csv",
    "faults/step_*.pt",
    "init_from.txt",
    "metrics.json",
    "pictures/model_v*.png",
    "pictures/step_*/*.png",
    *CURVES,
)
WRITTEN = tuple(dict.fromkeys(pattern.partition("/")[0] for pattern in _FILES))  #: Their top-level names


class Marker(BaseModel):
    """Content of ``run.json``.

    Attributes:
        id: ID of the run, which is kept when the run is moved, for provenance.
        config_hash: Hash of the configuration.
        resume: Value of ``resume`` that the run began with.
        job: SLURM job that last worked on the run.
        sessions: One entry per process that worked on the run; entries of killed processes have no
            ``outcome``.
    """

    model_config = ConfigDict(strict=True)
    id: str
    config_hash: str
    resume: str | None
    job: str | None
    sessions: list[dict[str, Any]] = []


def runs_in_order(sweep: Path) -> list[str]:
    """Folder names of a sweep's runs in the order of its commands, those of the last command first; empty
    if no file lists them."""
    with contextlib.suppress(InputError, OSError):
        names = lookup(read_yaml(sweep / PLAN), "runs")
        if isinstance(names, list):
            return list(map(str, names))
    return []


class RunDirectory:
    """Directory of a run; it need not exist.

    Args:
        path: Path of the directory.
        config_hash: Results of another configuration are ignored; None: accept results of any
            configuration.
    """

    def __init__(self, path: Path, config_hash: str | None = None) -> None:
        self.path = resolve_path(path)
        self.config_hash = config_hash
        self._lock = self.path / ".lock"

    def of(self, run: Run) -> "RunDirectory":
        """Return the same directory, accepting only results of this run's configuration."""
        return RunDirectory(self.path, config_hash(run.plain))

    @property
    def results(self) -> dict[str, Any] | None:
        """Content of ``metrics.json``; None if it is missing, unreadable or of another configuration."""
        path = self.path / "metrics.json"
        try:
            results = read_results(path) if path.is_file() else None
        except InputError:
            return None
        if results is None or self.config_hash is None:
            return results
        # The hash of a run is that of its command's configuration, which the verb may complete.
        hashes = [lookup(results["provenance"], key) for key in ("config_hash", "run.config_hash")]
        return results if self.config_hash in hashes else None

    @property
    def done(self) -> bool:
        return self.results is not None

    @property
    def metric(self) -> float | None:
        """Mean PSNR of the first protocol, in dB, by which a sweep compares its runs."""
        results = self.results
        return None if results is None else results["summary"][0].get("psnr")

    @property
    def checkpoint(self) -> Path | None:
        """Checkpoint from which an interrupted run resumes."""
        path = self.path / "checkpoints" / "last.ckpt"
        return path if path.is_file() else None

    @property
    def state(self) -> str:
        """``done``, ``running``, ``partial`` (to resume from its last checkpoint) or ``missing``."""
        if self.done:
            return "done"
        if is_locked(self._lock):
            return "running"
        return "partial" if self.checkpoint else "missing"

    @property
    def owner(self) -> str:
        """Description of the process that last locked the run, for messages."""
        return lock_owner(self._lock)

    def claim(self) -> contextlib.AbstractContextManager[bool]:
        """Lock the run for this process, see :func:`ghgs_lit.files.lock`."""
        return lock(self._lock)

    @property
    def marker(self) -> Marker | None:
        """Content of ``run.json``; None if the folder does not belong to a run.

        Raises:
            InputError: The file has another format.
        """
        path = self.path / MARKER
        if not path.is_file():
            return None
        return validate(Marker, read_json(path, "a run's identity"), str(path))

    def start(self, run: Run) -> str | None:
        """Checkpoint from which a run starts in this directory. Writes nothing.

        Args:
            run: Configuration of the run; in a new directory only the keys of its verb are read.

        Returns:
            Path of the checkpoint; None: start at the first step.

        Raises:
            InputError: The directory holds another run or foreign files.
        """
        require_no_links(self.path, WRITTEN)
        resume = run.resume
        given = None if resume == AUTO else resume
        if self._has(resume) or self.continues(run):
            checkpoint = resume if self._has(resume) else self.checkpoint
            return str(checkpoint) if checkpoint is not None else given
        owned = self.marker is not None
        there = [name for name in WRITTEN if os.path.lexists(self.path / name)]
        if not there:
            return given
        if not (run.overwrite and owned):
            raise InputError(f"{self.path}: {self._rejection(run, there[0])}")
        for key, source in (("init_from", getattr(run, "init_from", None)), ("resume", resume)):
            require(not self._has(source), key, "a file outside the run that overwrite=true deletes", source)
        return given

    def continues(self, run: Run) -> bool:
        """Whether the same command began the run in this directory."""
        marker = self.marker
        if marker is None or run.resume is None or marker.resume != run.resume:
            return False
        if run.overwrite and not (is_queued_again() and marker.job == slurm_job()):
            return False
        return marker.config_hash == config_hash(run.plain)

    def _has(self, path: str | None) -> bool:
        """Whether ``path`` is a file of this run."""
        return path not in (None, AUTO) and resolve_path(path).is_relative_to(self.path)

    def _rejection(self, run: Run, there: str) -> str:
        with contextlib.suppress(InputError):
            changed = differences(read_yaml(self.path / "config.yaml"), run.plain)
            there += f" of another configuration: {', '.join(changed[:3])}" * bool(changed)
        ways = "hydra.run.dir or hydra.sweep.subdir name another, resume=<checkpoint> goes on with its"
        ways += " weights, overwrite=true deletes a single run"
        return f"expected a directory without a run or other files of these names; found {there} ({ways})"

    def begin(self, run: Run) -> Run:
        """Turn the directory into that of a run, which this process must have claimed.

        Without a checkpoint to start from, previous output is deleted and the run trains from the
        beginning.

        Returns:
            The run, with ``resume`` set to the checkpoint to start from.

        Raises:
            InputError: See :meth:`start`.
        """
        start = self.start(run)
        goes_on = self._has(start)
        known = {"id": uuid.uuid4().hex[:8], "resume": run.resume, "sessions": []}
        if goes_on or self.continues(run):
            known = self.marker.model_dump()
        if not goes_on:
            self._clear(run)
        self._write(Marker(**{**known, "config_hash": config_hash(run.plain), "job": slurm_job()}))
        return run.replace(resume=start)

    def _write(self, marker: Marker) -> None:
        write_text_atomically(self.path / MARKER, marker.model_dump_json(indent=1) + "\n")

    def _clear(self, run: Run) -> None:
        """Delete the output of training."""
        options = run.plain.get("callbacks", {}).values()
        names = (re.sub(r"\{.*?\}", "*", each["filename"]) for each in options if each and "filename" in each)
        patterns = [*_FILES, *(f"checkpoints/{name}.ckpt" for name in names)]
        paths = [path for pattern in patterns for path in self.path.glob(pattern)]
        for path in paths:
            path.unlink()
        for folder in {path.parent for path in paths} - {self.path}:
            with contextlib.suppress(OSError):  # it holds files of the user
                folder.rmdir()

    def sessions(self) -> list[dict[str, Any]]:
        """Sessions of ``run.json``; none if the folder does not belong to a run."""
        marker = self.marker
        return marker.sessions if marker is not None else []

    @contextlib.contextmanager
    def session(self, resumed: str | None = None) -> Iterator[dict[str, Any]]:
        """Log start and end of this process in ``run.json``; requires the lock, after :meth:`begin`.

        Args:
            resumed: Checkpoint that the process resumed from; logged as a relative path if it lies in the
                run's directory.

        Yields:
            A dict for numbers such as steps and seconds, which are logged at the end.
        """
        if self._has(resumed):
            resumed = str(resolve_path(resumed).relative_to(self.path))
        session = {"started": _now(), "host": socket.gethostname(), "pid": os.getpid(), "resumed": resumed}
        marker = self.marker
        marker.sessions.append(session)
        self._write(marker)
        stats: dict[str, Any] = {}
        end = {"outcome": "done"}
        try:
            yield stats
        except BaseException as error:
            outcome = "failed" if isinstance(error, Exception) else "interrupted"
            end = {"outcome": outcome, "error": str(error)}
            raise
        finally:
            session |= {"ended": _now(), **end, **stats}
            self._write(marker)

    def find_first_session(self) -> dict[str, Any] | None:
        """Current session of the first of several processes of this training, with the absolute path of
        the checkpoint that it ``resumed`` from; None if it has not begun."""
        last = (self.sessions() or [{}])[-1]
        holder = f"process {last.get('pid')} on {last.get('host')}"
        if "outcome" in last or self.owner != holder or not is_locked(self._lock):
            return None
        resumed = last["resumed"]
        return {**last, "resumed": resumed and str(self.path / resumed)}


def _now() -> str:
    return datetime.datetime.now(datetime.UTC).isoformat(timespec="milliseconds")


def find_runs_of_job(folder: Path, pattern: str) -> list[RunDirectory]:
    """Runs on which the current SLURM job has worked; none outside SLURM.

    Args:
        folder: Folder that contains the runs.
        pattern: Glob pattern of their ``run.json`` relative to the folder.
    """
    runs = [RunDirectory(path.parent) for path in folder.glob(pattern)]
    return [run for run in runs if slurm_job() is not None and run.marker.job == slurm_job()]
