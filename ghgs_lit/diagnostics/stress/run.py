"""All cases of a run: divided among processes, written as they end, and not computed twice."""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

import torch

from ghgs_lit.diagnostics.stress.families import FAMILIES
from ghgs_lit.diagnostics.stress.measure import Row, measure
from ghgs_lit.diagnostics.stress.stages import STAGES
from ghgs_lit.errors import choice
from ghgs_lit.runs.journal import Journal
from ghgs_lit.runs.progress import track


@dataclass(frozen=True)
class Task:
    """The cells of one stage and family."""

    stage: str
    family: str
    seeds: int

    @property
    def key(self) -> str:
        """A name that no other task has."""
        return "/".join((self.stage, self.family, str(self.seeds)))

    def run(self) -> list[Row]:
        """One row for each dtype."""
        rows = measure(STAGES[self.stage], self.family, range(self.seeds))
        return [{**row, "seeds": self.seeds} for row in rows]


def tasks_of(
    stages: Sequence[str] | None = None, families: Sequence[str] | None = None, quick: bool = False
) -> list[Task]:
    """Everything to run; None: all stages or families. InputError: a name that is not known."""
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
    """The rows of all tasks; those that ``journal`` has already are read from it. ``journal``: a file of one
    line for each task, which is written as the tasks end. ``workers``: processes; 0: this one."""
    done = Journal(journal)
    done.say_done([task.key for task in tasks], "families")
    left = [task for task in tasks if task.key not in done]
    with _mapping(workers) as map_tasks:
        for task, rows in zip(track(left, "stages and families"), map_tasks(Task.run, left), strict=True):
            done.add(task.key, rows)
    return [row for task in tasks for row in done[task.key]]


@contextmanager
def _mapping(workers: int) -> Iterator[Callable[..., Iterator]]:
    """``map`` in this process, or divided among others."""
    if workers == 0:
        yield map
        return
    # Not forked: a child would inherit locks of threads that it does not have.
    pool = ProcessPoolExecutor(
        workers, get_context("spawn"), initializer=torch.set_num_threads, initargs=(1,)
    )
    try:
        yield pool.map
    finally:
        pool.shutdown(cancel_futures=True)
