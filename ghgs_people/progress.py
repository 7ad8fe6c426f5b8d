"""Progress of rendering on disk, so that a killed run can resume; :mod:`ghgs_lit.data.layout` reads
it. Besides the files described there, ``<root>/rendering/`` has ``settings.json`` (the settings of
the files), ``lock`` and ``tmp/`` (workspaces)."""

import contextlib
import json
import logging
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from ghgs_lit.config.keys import flatten
from ghgs_lit.data.layout import Completeness, lights_of
from ghgs_lit.errors import InputError, require
from ghgs_lit.files import is_locked, lock, lock_owner, write_text_atomically
from ghgs_lit.parsing import read_json

log = logging.getLogger(__name__)

_KINDS = ("mask", "alpha", "depth", "parm", "img", "smpl")


class Progress(Completeness):
    """The progress of rendering the data set at ``root``."""

    def check_settings(self, settings: dict) -> None:
        """Store the settings in an empty data set; refuse a data set with others.

        Args:
            settings: nested plain data (:func:`ghgs_people.jobs.identity`).

        Raises:
            InputError: the data set has other settings, or files that were not rendered here.
        """
        path = self.folder / "settings.json"
        foreign = self.root.is_dir() and any(p != self.folder for p in self.root.iterdir())
        if not path.exists():
            if foreign:
                raise InputError(
                    f"{self.root}: expected an empty folder or one rendered here before; found other files"
                )
            _write_json(path, settings)
        wanted = lights_of(settings["render"])
        stored = self.lights
        if wanted != stored:
            raise InputError(
                f"{path}: expected data.render.lights={wanted}; found {stored} (render into another"
                f" folder, or data.render.lights={stored} goes on with this one)"
            )
        kept = flatten(read_json(path))
        settings = flatten(json.loads(json.dumps(settings)))  # tuples to lists, as they were stored
        for key in sorted(settings.keys() | kept.keys()):
            if settings.get(key) != kept.get(key):
                raise InputError(
                    f"{path}: expected {key} = {settings.get(key)}; found {kept.get(key)} "
                    "(render into another folder, or delete this one)"
                )

    def request(self, names: Mapping[str, Sequence[str]]) -> None:
        """Store that subjects were requested; call under the lock.

        Args:
            names: subjects of each phase.
        """
        known = self.plan
        phases = known.keys() | names.keys()
        plan = {p: sorted({*known.get(p, []), *names.get(p, [])}) for p in phases}
        _write_json(self.folder / "plan.json", plan)

    @contextlib.contextmanager
    def lock(self) -> Iterator[None]:
        """Hold the lock for writing; the system frees it when a process dies.

        Raises:
            InputError: this process holds it already, or the file system has no locks.
        """
        path = self.folder / "lock"
        if is_locked(path):
            log.info("waiting for %s, which renders into %s", lock_owner(path), self.root)
        with lock(path, wait=True) as held:
            require(held, str(self.root), "one rendering at a time in a process", "another")
            yield

    def workspace(self, phase: str, name: str) -> Path:
        """Make an empty folder for the files of a subject.

        Args:
            phase: ``train``, ``val`` or another name of a part of the data.
            name: of the subject.
        """
        path = self.folder / "tmp" / f"{phase}-{name}"
        shutil.rmtree(path, ignore_errors=True)
        path.mkdir(parents=True)
        return path

    def publish(self, workspace: Path, phase: str, name: str) -> None:
        """Move a subject to its place, then mark it as complete.

        Args:
            workspace: folder that holds all its files.
            phase: that the subject belongs to.
            name: of the subject.
        """
        for kind in _KINDS:
            for source in sorted((workspace / kind).glob("*")):
                target = self.root / phase / kind / source.name
                target.parent.mkdir(parents=True, exist_ok=True)
                if target.exists():  # left by a run that was killed between two moves
                    shutil.rmtree(target)
                os.replace(source, target)
        marker = self.marker(phase, name)
        marker.parent.mkdir(parents=True, exist_ok=True)
        marker.touch()
        shutil.rmtree(workspace, ignore_errors=True)

    def clear_workspaces(self) -> None:
        """Remove workspaces of killed runs; call under the lock."""
        shutil.rmtree(self.folder / "tmp", ignore_errors=True)


def _write_json(path: Path, content: dict) -> None:
    write_text_atomically(path, json.dumps(content, indent=1))
