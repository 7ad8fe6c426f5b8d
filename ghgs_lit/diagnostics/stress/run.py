"""Run of a stress test: its cells, by stage and family, in several processes."""

import itertools
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context

import torch

from ghgs_lit.diagnostics.stress.measure import Row, measure
from ghgs_lit.diagnostics.stress.stage import FAMILIES
from ghgs_lit.diagnostics.stress.stages import STAGES
from ghgs_lit.errors import choice
from ghgs_lit.runs.progress import track


@dataclass(frozen=True)
class Task:
    """Cells of one stage and family."""

    stage: str
    family: str
    seeds: int

    def run(self) -> list[Row]:
        """One row for each dtype."""
        return measure(STAGES[self.stage], self.family, range(self.seeds))


def tasks_of(
    stages: Sequence[str] | None = None, families: Sequence[str] | None = None, quick: bool = False
) -> list[Task]:
    """Tasks of the chosen stages and families.

    Args:
        stages: names; None: all.
        families: names; None: all. A stage has no task of a family that does not apply to it.
        quick: few cases of each.

    Raises:
        InputError: an unknown name.
    """
    for key, names, known in (("stages", stages, STAGES), ("families", families, FAMILIES)):
        for name in names or ():
            choice(key, name, tuple(known))
    tasks = []
    for name in STAGES if stages is None else stages:
        stage = STAGES[name]
        seeds = stage.quick if quick else stage.seeds
        for family in FAMILIES if families is None else families:
            if stage.has(family):
                tasks.append(Task(name, family, seeds))
    return tasks


def run_tasks(tasks: Sequence[Task], workers: int) -> list[Row]:
    """Rows of all tasks, in their order.

    Args:
        tasks: what to run.
        workers: number of processes; 0: this one.
    """
    if workers == 0:
        rows = map(Task.run, track(tasks, "stages and families"))
        return list(itertools.chain.from_iterable(rows))
    # Spawned: a forked child would inherit locks of threads that it does not have.
    pool = ProcessPoolExecutor(
        workers, get_context("spawn"), initializer=torch.set_num_threads, initargs=(1,)
    )
    try:
        done = zip(track(tasks, "stages and families"), pool.map(Task.run, tasks), strict=True)
        return list(itertools.chain.from_iterable(rows for _, rows in done))
    finally:
        pool.shutdown(cancel_futures=True)
