"""All cases of a run, divided among processes."""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import get_context

import torch

from ghgs_lit.diagnostics.stress.families import FAMILIES
from ghgs_lit.diagnostics.stress.measure import Row, measure
from ghgs_lit.diagnostics.stress.stages import STAGES
from ghgs_lit.errors import choice
from ghgs_lit.runs.progress import track


@dataclass(frozen=True)
class Task:
    """The cells of one stage and family."""

    stage: str
    family: str
    seeds: int

    def run(self) -> list[Row]:
        """One row for each dtype."""
        rows = measure(STAGES[self.stage], self.family, range(self.seeds))
        return [{**row, "seeds": self.seeds} for row in rows]


def tasks_of(
    stages: Sequence[str] | None = None,
    families: Sequence[str] | None = None,
    quick: bool = False,
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


def run_tasks(tasks: Sequence[Task], workers: int) -> list[Row]:
    """The rows of all tasks. ``workers``: processes; 0: this one."""
    with _mapping(workers) as map_tasks:
        found = zip(track(tasks, "stages and families"), map_tasks(Task.run, tasks), strict=True)
        return [row for _, rows in found for row in rows]


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
