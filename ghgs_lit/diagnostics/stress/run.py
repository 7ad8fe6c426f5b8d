"""Run of a stress test: tasks in several processes, with a journal so that none is computed twice."""

import json
import zlib
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from multiprocessing import get_context
from pathlib import Path

import torch

import ghgs_lit
from ghgs_lit.diagnostics.stress.measure import Row, measure
from ghgs_lit.diagnostics.stress.stage import FAMILIES
from ghgs_lit.diagnostics.stress.stages import STAGES
from ghgs_lit.errors import choice
from ghgs_lit.files import append_line
from ghgs_lit.readers import read_lines_of_json
from ghgs_lit.runs.progress import track


@cache
def code_digest() -> str:
    """Checksum of the package's sources; rows of other code are not reused."""
    digest = 0
    for path in sorted(Path(ghgs_lit.__file__).parent.rglob("*.py")):
        digest = zlib.crc32(path.read_bytes(), digest)
    return f"{digest:08x}"


class Journal(dict[str, list[Row]]):
    """Rows of finished tasks by key, including those of earlier runs with the same code."""

    def __init__(self, path: Path) -> None:
        self.path = path
        entries = read_lines_of_json(path) if path.exists() else ()
        super().__init__((e["key"], e["rows"]) for e in entries if e.get("code") == code_digest())

    def add(self, key: str, rows: list[Row]) -> None:
        """Add a finished task and append it to the file."""
        append_line(self.path, json.dumps({"key": key, "code": code_digest(), "rows": rows}))
        self[key] = rows


@dataclass(frozen=True)
class Task:
    """Cells of one stage and family."""

    stage: str
    family: str
    seeds: int

    @property
    def key(self) -> str:
        """Unique name of the task."""
        return "/".join((self.stage, self.family, str(self.seeds)))

    def run(self) -> list[Row]:
        """One row for each dtype."""
        rows = measure(STAGES[self.stage], self.family, range(self.seeds))
        return [{**row, "seeds": self.seeds} for row in rows]


def tasks_of(
    stages: Sequence[str] | None = None, families: Sequence[str] | None = None, quick: bool = False
) -> list[Task]:
    """Tasks of the chosen stages and families (None: all). InputError: an unknown name."""
    stages = _chosen("stages", stages, tuple(STAGES))
    families = _chosen("families", families, tuple(FAMILIES))
    return [
        Task(name, family, STAGES[name].quick if quick else STAGES[name].seeds)
        for name in stages
        for family in families
        if STAGES[name].missing(family) is None
    ]


def _chosen(key: str, names: Sequence[str] | None, known: tuple[str, ...]) -> tuple[str, ...]:
    for name in names or ():
        choice(key, name, known)
    return known if names is None else tuple(names)


def run_tasks(tasks: Sequence[Task], journal: Path, workers: int) -> list[Row]:
    """Rows of all tasks. ``journal``: file with a line for each finished task, which is not run again.
    ``workers``: number of processes; 0: this one."""
    done = Journal(journal)
    left = [task for task in tasks if task.key not in done]
    if count := len(tasks) - len(left):
        print(f"{journal}: {count} of {len(tasks)} families are done already", flush=True)
    with _mapping(workers) as map_tasks:
        for task, rows in zip(track(left, "stages and families"), map_tasks(Task.run, left), strict=True):
            done.add(task.key, rows)
    return [row for task in tasks for row in done[task.key]]


@contextmanager
def _mapping(workers: int) -> Iterator[Callable[..., Iterator]]:
    if workers == 0:
        yield map
        return
    # Spawned: a forked child would inherit locks of threads that it does not have.
    pool = ProcessPoolExecutor(
        workers, get_context("spawn"), initializer=torch.set_num_threads, initargs=(1,)
    )
    try:
        yield pool.map
    finally:
        pool.shutdown(cancel_futures=True)
