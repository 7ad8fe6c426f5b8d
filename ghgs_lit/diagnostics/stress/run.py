"""All cases of a run: divided among processes, written as they end, and not computed twice."""

import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

import torch

from ghgs_lit.diagnostics.stress.families import FAMILIES
from ghgs_lit.diagnostics.stress.measure import measure
from ghgs_lit.diagnostics.stress.stage import DTYPES
from ghgs_lit.diagnostics.stress.stages import STAGES
from ghgs_lit.errors import choice
from ghgs_lit.runs.journal import Journal
from ghgs_lit.runs.progress import track

Row = dict[str, str | int | float | None]


@dataclass(frozen=True)
class Task:
    """The cells of one stage and family."""

    stage: str
    family: str
    seeds: int
    dtypes: tuple[str, ...]

    def run(self) -> list[Row]:
        """One row for each dtype."""
        cells = measure(STAGES[self.stage], self.family, range(self.seeds), self.dtypes)
        return [{**cell.as_dict(), "seeds": self.seeds} for cell in cells]


def tasks_of(
    stages: Sequence[str] | None = None,
    families: Sequence[str] | None = None,
    dtypes: Sequence[str] | None = None,
    quick: bool = False,
) -> list[Task]:
    """Everything to run; None: all stages, families or dtypes.

    Raises:
        InputError: a name that is not known.
    """
    chosen = []
    for key, names, known in (
        ("stages", stages, tuple(STAGES)),
        ("families", families, tuple(FAMILIES)),
        ("dtypes", dtypes, DTYPES),
    ):
        for name in names or ():
            choice(key, name, known)
        chosen.append(tuple(known if names is None else names))
    return [
        Task(name, family, STAGES[name].quick if quick else STAGES[name].seeds, chosen[2])
        for name in chosen[0]
        for family in chosen[1]
        if STAGES[name].missing(family) is None
    ]


def run_tasks(tasks: Sequence[Task], journal: Path, workers: int) -> list[Row]:
    """The rows of all tasks; those that ``journal`` has already are read from it.

    Args:
        tasks: what to run.
        journal: a file of one line for each task, which is written as the tasks end.
        workers: processes; 0: this one.
    """
    done = Journal(journal)
    done.say_done([_key(task) for task in tasks], "families")
    left = [task for task in tasks if _key(task) not in done]
    for task, rows in track(_Sized(_results(left, workers), len(left)), "stages and families"):
        done.add(_key(task), rows)
    return [row for task in tasks for row in done[_key(task)]]


@dataclass(frozen=True)
class _Sized:
    """An iterator whose length is known, for a progress bar."""

    items: Iterator
    length: int

    def __iter__(self) -> Iterator:
        return self.items

    def __len__(self) -> int:
        return self.length


def _key(task: Task) -> str:
    return "/".join((task.stage, task.family, str(task.seeds), ",".join(task.dtypes)))


def _results(tasks: Sequence[Task], workers: int) -> Iterator[tuple[Task, list[Row]]]:
    if workers == 0:
        yield from ((task, task.run()) for task in tasks)
        return
    # Not forked: a child would inherit locks of threads that it does not have.
    pool = ProcessPoolExecutor(
        workers, get_context("spawn"), initializer=torch.set_num_threads, initargs=(1,)
    )
    try:
        futures = {pool.submit(task.run): task for task in tasks}
        for future in as_completed(futures):
            yield futures[future], future.result()
    finally:
        pool.shutdown(cancel_futures=True)


def processes(workers: int | None) -> int:
    """``workers``, or one for each processor of this process."""
    return (
        len(os.sched_getaffinity(0)) if workers is None and hasattr(os, "sched_getaffinity") else workers or 0
    )
