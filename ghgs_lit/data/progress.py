"""What of a rendered data set is finished, kept beside it so that a killed run can go on.

``<root>/rendering/`` holds ``settings.json`` (what the files were made with), ``plan.json`` (subjects of
each phase that were asked for), ``done/<phase>/<subject>`` (one empty file for each whole subject,
written last) and ``tmp/`` (what is being written). A folder without ``rendering/`` was made elsewhere:
everything in it counts as finished.
"""

import contextlib
import fcntl
import json
import logging
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from ghgs_lit.errors import InputError

log = logging.getLogger(__name__)

KINDS = ("mask", "depth", "parm", "img", "smpl")


class Progress:
    """The state of the data set at ``root``."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.folder = root / "rendering"

    @property
    def tracked(self) -> bool:
        """Whether this data set was rendered by this package."""
        return self.folder.is_dir()

    def done(self, phase: str, name: str) -> bool:
        return (self.folder / "done" / phase / name).exists()

    def missing(self, phase: str, names: Sequence[str]) -> list[str]:
        """Those of ``names`` that are not wholly rendered."""
        return [name for name in names if not self.done(phase, name)] if self.tracked else []

    def check_settings(self, settings: dict) -> None:
        """Remember ``settings`` in an empty data set; refuse a data set made with others."""
        path = self.folder / "settings.json"
        foreign = self.root.is_dir() and any(p.name != "rendering" for p in self.root.iterdir())
        if not path.exists():
            if foreign:
                raise InputError(
                    f"{self.root}: expected an empty folder or one rendered here before; found other files"
                )
            self.folder.mkdir(parents=True, exist_ok=True)
            _write_json(path, settings)
        found = _flat(json.loads(path.read_text()))
        settings = _flat(json.loads(json.dumps(settings)))  # tuples to lists, as they were stored
        for key in sorted(settings.keys() | found.keys()):
            if settings.get(key) != found.get(key):
                raise InputError(
                    f"{path}: expected {key} = {settings.get(key)}; found {found.get(key)} "
                    "(render into another folder, or delete this one)"
                )

    def planned(self, phase: str) -> list[str]:
        """Subjects of ``phase`` that were asked for so far, done or not."""
        path = self.folder / "plan.json"
        return json.loads(path.read_text()).get(phase, []) if path.exists() else []

    def plan(self, names: Mapping[str, Sequence[str]]) -> None:
        """Remember that these subjects were asked for; only under the lock."""
        path = self.folder / "plan.json"
        known = json.loads(path.read_text()) if path.exists() else {}
        phases = known.keys() | names.keys()
        _write_json(path, {p: sorted({*known.get(p, []), *names.get(p, [])}) for p in phases})

    @contextlib.contextmanager
    def lock(self) -> Iterator[None]:
        """Let one process at a time write; the system frees the lock when a process dies."""
        self.folder.mkdir(parents=True, exist_ok=True)
        with open(self.folder / "lock", "w") as handle:
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                log.info("waiting for another process that renders into %s", self.root)
                fcntl.flock(handle, fcntl.LOCK_EX)
            yield

    def workspace(self, phase: str, name: str) -> Path:
        """An empty folder to write a subject into."""
        path = self.folder / "tmp" / f"{phase}-{name}"
        shutil.rmtree(path, ignore_errors=True)
        path.mkdir(parents=True)
        return path

    def publish(self, workspace: Path, phase: str, name: str) -> None:
        """Move a whole subject from its workspace to its place, then mark it done."""
        for kind in KINDS:
            for source in sorted((workspace / kind).glob("*")):
                target = self.root / phase / kind / source.name
                target.parent.mkdir(parents=True, exist_ok=True)
                if target.exists():  # left by a run that was killed between two moves
                    shutil.rmtree(target)
                os.replace(source, target)
        marker = self.folder / "done" / phase / name
        marker.parent.mkdir(parents=True, exist_ok=True)
        marker.touch()
        shutil.rmtree(workspace, ignore_errors=True)

    def clear_workspaces(self) -> None:
        """Remove what killed runs left; only under the lock."""
        shutil.rmtree(self.folder / "tmp", ignore_errors=True)


def _flat(content: dict, prefix: str = "") -> dict:
    """Nested keys joined with dots."""
    flat = {}
    for key, value in content.items():
        flat |= _flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {f"{prefix}{key}": value}
    return flat


def _write_json(path: Path, content: dict) -> None:
    """Write all of a file or nothing."""
    fresh = path.with_suffix(f".{os.getpid()}")
    fresh.write_text(json.dumps(content, indent=1))
    os.replace(fresh, path)
