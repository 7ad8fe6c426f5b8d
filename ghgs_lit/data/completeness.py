"""Which subjects of a rendered data set are complete, from what the renderer noted beside it.

``<root>/rendering/`` holds ``plan.json`` (the subjects of each phase that were requested) and
``done/<phase>/<subject>`` (one empty file for each complete subject, written last). A data set without
``rendering/`` was made elsewhere: everything in it counts as complete.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ghgs_lit.errors import require
from ghgs_lit.readers import read_json

#: The renderer's notes, below the root of a data set.
FOLDER = "rendering"


@dataclass(frozen=True)
class Completeness:
    """The notes of the data set at ``root``, for reading."""

    root: Path

    @property
    def folder(self) -> Path:
        return self.root / FOLDER

    @property
    def rendered_here(self) -> bool:
        """Whether this package rendered the data set."""
        return self.folder.is_dir()

    @property
    def plan(self) -> dict[str, list[str]]:
        """Subjects of each phase that were requested so far, complete or not."""
        path = self.folder / "plan.json"
        plan = read_json(path) if path.exists() else {}
        subjects = plan.values() if isinstance(plan, dict) else [plan]
        fits = all(isinstance(names, list) and all(isinstance(n, str) for n in names) for names in subjects)
        require(fits, str(path), "lists of subjects by phase", plan)
        return plan

    def marker(self, phase: str, name: str) -> Path:
        """The file that marks a subject as complete."""
        return self.folder / "done" / phase / name

    def missing(self, phase: str, names: Sequence[str]) -> list[str]:
        """Those of ``names`` that are not completely rendered."""
        return [name for name in names if not self.marker(phase, name).exists()] if self.rendered_here else []

    def whole(self, phase: str, names: Sequence[str]) -> list[str]:
        """Those of ``names`` that are completely rendered."""
        missing = set(self.missing(phase, names))
        return [name for name in names if name not in missing]
