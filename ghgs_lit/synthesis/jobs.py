"""Renders many people into the layout: in several processes, resumable, the same files for the same seed.

Workers are spawned (a fork of a process that runs threads may hang): each imports the script that called
:func:`render_people`, which therefore needs ``if __name__ == "__main__":``. Workers write into workspaces
only; the process that holds the lock moves finished subjects to their place.
"""

import contextlib
import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np
import torch
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
from rich.progress import Progress as Bar

from ghgs_lit.config.settings import from_config, image_size, set_fields
from ghgs_lit.data.layout import position_name
from ghgs_lit.data.sampling import VIEW_NUMBERS, subject_rng
from ghgs_lit.data.view import View, encode_depth
from ghgs_lit.errors import InputError, require
from ghgs_lit.synthesis import people
from ghgs_lit.synthesis.people.mesh import Person
from ghgs_lit.synthesis.photograph import Lights, Studio
from ghgs_lit.synthesis.progress import Progress
from ghgs_lit.synthesis.rig import Rig, Variation
from ghgs_lit.synthesis.writing import write_body, write_view

_GUARD = 'if __name__ == "__main__":'
# Part of every cache key: increase it when photographs of the same settings would change.
RENDER_VERSION = 2


class Source(Protocol):
    """Where people come from; must survive pickling."""

    def load(self, name: str) -> Person: ...

    def facing(self, name: str) -> float:
        """Degrees about y that the first camera is turned by, to look at the front."""


#: First letter of the names of generated people in poses of sport and dance.
ACTIVE = "a"


@dataclass(frozen=True)
class SyntheticSource:
    """Generated people, named ``p<index>``, and those in poses of sport and dance, ``a<index>``."""

    seed: int

    def load(self, name: str) -> Person:
        return people.generate(self.seed, int(name[1:]), active=name.startswith(ACTIVE))

    def facing(self, name: str) -> float:
        return 0.0


@dataclass(frozen=True)
class RenderSettings:
    """What is rendered of each person.

    Attributes:
        size: side or (height, width) in pixels.
        samples: each pixel is the mean of ``samples`` x ``samples`` rays.
        positions: positions of the ring that are rendered (null: all).
        views: numbers of the views at each position (:mod:`ghgs_lit.synthesis.rig`); targets need 0, 2, 3 and
            4, stereo methods need 1.
        quality: of the JPEG files, 1 to 100.
        lights: settings of the lights or their mapping.
    """

    size: int | tuple[int, int] = 512
    samples: int = 3
    positions: tuple[int, ...] | None = None
    views: tuple[int, ...] = (0, 2, 3, 4)
    quality: int = 98
    lights: Lights = field(default_factory=Lights)

    def __post_init__(self) -> None:
        require(1 <= self.samples <= 16, "data.render.samples", "between 1 and 16", self.samples)
        require(1 <= self.quality <= 100, "data.render.quality", "between 1 and 100", self.quality)
        known = len(self.views) > 0 and set(self.views) <= set(VIEW_NUMBERS)
        require(known, "data.render.views", f"some of {list(VIEW_NUMBERS)}", list(self.views))
        set_fields(
            self,
            size=image_size("data.render.size", self.size),
            lights=from_config(Lights, "data.render.lights", self.lights),
            views=tuple(self.views),
            positions=None if self.positions is None else tuple(self.positions),
        )


@dataclass(frozen=True)
class _Job:
    source: Source
    rig: Rig
    settings: RenderSettings
    seed: int
    phase: str
    name: str
    workspace: Path


def identity(rig: Rig, settings: RenderSettings, seed: int) -> dict:
    """Everything that photographs of a given person depend on, as plain data."""
    render = asdict(settings)
    render["vids"] = render.pop("views")  # the name in stored data sets and in the keys of caches
    cameras, still = asdict(rig), asdict(Variation())
    # The name of a cache does not depend on what does not vary.
    varied = {name: value for name, value in cameras.pop("variation").items() if value != still[name]}
    if varied:
        cameras["variation"] = varied
    return {"version": RENDER_VERSION, "seed": seed, "rig": cameras, "render": render}


def render_subject(job: _Job) -> _Job:
    """Render one subject into its workspace."""
    rng = subject_rng(job.seed, job.name)
    person = job.rig.place(job.source.load(job.name), rng)
    yaws, lights = job.rig.yaws(rng) + job.source.facing(job.name), job.settings.lights.draw(rng)
    height, width = job.settings.size
    # Random numbers of their own: heights, yaws and lights do not depend on what is varied.
    rig, poses = job.rig.drawn(person, yaws, width / height, rng.spawn(1)[0])
    studio = Studio(person, lights, job.settings.samples)
    numbers = job.settings.views
    positions = range(job.rig.positions) if job.settings.positions is None else job.settings.positions
    for position in positions:
        index = (position, list(numbers))
        cameras = rig.cameras(yaws[index], height, width, poses[index])
        photographs = studio.shoot(cameras)
        for n, number in enumerate(numbers):
            view = View(
                image=np.round(photographs.images[n] * 255).astype(np.uint8),
                mask=photographs.masks[n],
                inverse_depth=encode_depth(photographs.depths[n]),
                intrinsics=cameras.intrinsics[n].numpy(),
                extrinsics=cameras.extrinsics[n].numpy(),
                matte=np.round(photographs.alphas[n] * 255).astype(np.uint8),
            )
            folder = position_name(job.name, position)
            write_view(job.workspace, folder, number, view, job.settings.quality)
    if person.body_vertices is not None:
        write_body(job.workspace, job.name, person.body_vertices)
    return job


def render_people(
    root: Path,
    names: Mapping[str, Sequence[str]],
    source: Source,
    rig: Rig,
    settings: RenderSettings,
    seed: int,
    workers: int | None = None,
) -> int:
    """Render people below ``root``; those that are already there are kept.

    It is safe to kill, to repeat, and to start twice at once: a second process waits for the first.

    Args:
        root: folder of the rendered data set.
        names: names of the subjects of each phase.
        source: loads them.
        rig: the cameras, and how subjects are placed.
        settings: what is rendered.
        seed: seed of heights, yaws and lights.
        workers: number of processes (None: one for each core; 0: this one).

    Returns:
        How many subjects were rendered now.

    Raises:
        InputError: ``root`` holds something else, a person is bad, or the script has no main guard.
    """
    _check_main_guard()
    require(workers is None or workers >= 0, "data.render_workers", "at least 0 or null", workers)
    positions = settings.positions
    fits = positions is None or set(positions) <= set(range(rig.positions))
    require(fits, "data.render.positions", f"some of 0 to {rig.positions - 1}", positions)
    progress = Progress(Path(root))
    progress.check_settings(identity(rig, settings, seed))
    missing = progress.complete.missing
    if not any(missing(phase, listed) for phase, listed in names.items()):
        return 0
    with progress.lock():
        progress.check_settings(identity(rig, settings, seed))  # another process may have been faster
        progress.clear_workspaces()
        progress.plan(names)
        todo = [
            _Job(source, rig, settings, seed, phase, name, progress.workspace(phase, name))
            for phase, listed in names.items()
            for name in missing(phase, listed)
        ]
        with _bar() as bar:
            task = bar.add_task(f"rendering into {root}", total=len(todo))
            try:
                with contextlib.closing(_run(todo, workers)) as finished:
                    for job in finished:
                        progress.publish(job.workspace, job.phase, job.name)
                        bar.advance(task)
            finally:
                progress.clear_workspaces()
    return len(todo)


def _run(jobs: list[_Job], workers: int | None) -> Iterator[_Job]:
    """Finished jobs, in the order in which they finish."""
    workers = min(len(jobs), os.cpu_count() or 1 if workers is None else workers)
    if workers < 2:
        yield from map(render_subject, jobs)
        return
    if multiprocessing.get_start_method() not in multiprocessing.get_all_start_methods():
        # A worker of joblib: its start method is inherited by name, and a fresh process does not know it.
        multiprocessing.set_start_method("spawn", force=True)
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, context, initializer=_start_worker) as pool:
        try:
            futures = [pool.submit(render_subject, job) for job in jobs]
            for future in as_completed(futures):
                yield future.result()
        except BrokenProcessPool as error:
            raise RuntimeError(
                f"a rendering process died: the script lacks `{_GUARD}`, or memory ran out (repeat to go on)"
            ) from error
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


def _check_main_guard() -> None:
    """End a worker that runs the calling script again: it would wait for its parent, and that for it."""
    # Set by multiprocessing while a spawned process imports the main module of its parent.
    if getattr(multiprocessing.current_process(), "_inheriting", False):
        raise InputError(
            f"{sys.argv[0]}: expected `{_GUARD}` around what a script does (rendering processes import it), "
            "or data.render_workers=0; found neither"
        )


def _start_worker() -> None:
    """One thread for each process; Ctrl-C is left to the parent; a worker ends with its parent."""
    torch.set_num_threads(1)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """Nothing else ends a worker whose parent is killed (``kill``, ``kill -9``, the batch system)."""
    multiprocessing.parent_process().join()
    os._exit(1)


def _bar() -> Bar:
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    return Bar(*columns, console=Console(stderr=True))
