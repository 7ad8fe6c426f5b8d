"""Render many people in several processes: resumable, and reproducible for the same seed.

Workers are spawned (forking a process with threads may hang): each imports the script that called
:func:`render_people`, which therefore needs ``if __name__ == "__main__":``. They write to workspaces;
the process that holds the lock moves finished subjects to their place (:mod:`ghgs_lit.data.layout`). In
addition to the files described there, ``<root>/rendering/`` contains ``settings.json`` (the settings of
the files), ``lock`` and ``tmp/`` (workspaces)."""

import functools
import json
import logging
import multiprocessing
import os
import shutil
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal
from unittest import mock

import numpy as np
import torch
from PIL import Image
from pydantic import Field
from rich.console import Console
from rich.progress import track

from ghgs_lit.config.keys import flatten
from ghgs_lit.config.options import Index, Options, Size
from ghgs_lit.data.layout import Completeness, position_name
from ghgs_lit.data.sampling import RING_VIEW, ViewNumber, subject_rng
from ghgs_lit.data.view import View, encode_depth
from ghgs_lit.errors import InputError, require
from ghgs_lit.files import lock, name_folder_in_errors, write_text_atomically
from ghgs_lit.parsing import read_json
from ghgs_lit.runtime.cores import allowed_cores, use_known_start_method
from ghgs_people import figures
from ghgs_people.cpu.kernel import compile_kernels
from ghgs_people.figures.mesh import Person
from ghgs_people.lights import Lights
from ghgs_people.photograph import Studio
from ghgs_people.rig import STILL, Rig
from ghgs_people.scans import ScanSource

log = logging.getLogger(__name__)

# Part of every cache key; increase it when the same settings yield other photographs
RENDER_VERSION = 3
#: One thread per worker, since the threads of NumPy's matrix products wait by spinning
_ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
#: Folders of a subject's files, in the order in which they are moved to their place
_KINDS = ("mask", "alpha", "depth", "parm", "img", "smpl")
# zlib's Z_RLE: half the time of the default, with files no larger
_PNG = {"compress_type": 3}
#: Distribution of the lights of all people
LIGHTS = Lights()


#: First letter of the names of generated people in poses of sport and dance
ACTIVE = "a"


@dataclass(frozen=True)
class SyntheticSource:
    """Generator of people, named ``p<index>``, or ``a<index>`` in poses of sport and dance.

    Args:
        seed: seed of the population, at least 0.
    """

    seed: int

    def load(self, name: str) -> Person:
        return figures.generate(self.seed, int(name[1:]), name.startswith(ACTIVE))

    def facing(self, name: str) -> float:
        return 0.0


#: Loaders of people; picklable.
PersonSource = SyntheticSource | ScanSource


class RenderOptions(Options):
    """Renderings of each person."""

    group = "data.render"

    size: Size = 512
    """Side or [height, width] of the photographs in pixels."""
    samples: int = Field(3, ge=1, le=16)
    """Rays along each side of a pixel, which is the mean of samples x samples rays."""
    positions: tuple[Index, ...] | None = None
    """Ring positions to render; null: all."""
    views: tuple[ViewNumber, ...] = Field((RING_VIEW, 2, 3, 4), min_length=1)
    """Views at each position: 0 the ring camera, 1 the next one, 3 halfway, 2 and 4 random in between.
    Targets need 0, 2, 3 and 4; stereo methods need 1."""
    quality: int = Field(98, ge=1, le=100)
    """Quality of the JPEG files."""
    lights: Literal["studio", "none"] = "studio"
    """studio: white lights around each person, for textures without shading; none: textures unchanged, for
    scans, whose textures are photographs that already contain the lighting."""


def everything(rig: Rig, settings: RenderOptions) -> dict:
    """All settings, except the seed, that photographs of a person depend on.

    Returns:
        Plain data with the keys ``rig`` and ``render``.
    """
    cameras = {**asdict(rig), "variation": rig.variation.model_dump()}
    lights = asdict(LIGHTS) if settings.lights == "studio" else settings.lights
    return {"rig": cameras, "render": {**settings.model_dump(), "lights": lights}}


def identity(rig: Rig, settings: RenderOptions, seed: int) -> dict:
    """Settings of :func:`everything` with seed and renderer version, as plain data for cache keys and
    stored settings.

    Args:
        rig: the cameras.
        settings: renderings of each person.
        seed: seed of heights, yaws and lights.
    """
    cameras, render = everything(rig, settings).values()
    render["vids"] = render.pop("views")  # name in stored data sets and cache keys
    still = STILL.model_dump()
    # Names of caches do not depend on variations that are disabled.
    varied = {name: value for name, value in cameras.pop("variation").items() if value != still[name]}
    if varied:
        cameras["variation"] = varied
    return {"version": RENDER_VERSION, "seed": seed, "rig": cameras, "render": render}


def render_person(
    source: PersonSource, rig: Rig, settings: RenderOptions, seed: int, workspace: Path, name: str
) -> str:
    """Render one person into a folder; returns why the person is invalid, or an empty text."""
    try:
        _render(source, rig, settings, seed, workspace, name)
    except InputError as error:
        return str(error)
    return ""


def _render(
    source: PersonSource, rig: Rig, settings: RenderOptions, seed: int, workspace: Path, name: str
) -> None:
    rng = subject_rng(seed, name)
    person = rig.place(source.load(name), rng)
    yaws = rig.yaws(rng) + source.facing(name)
    lights = LIGHTS.draw(rng)
    height, width = settings.size
    # A separate generator, so that heights, yaws and lights do not depend on variations.
    rig, poses = rig.vary(person, yaws, width / height, rng.spawn(1)[0])
    studio = Studio(person, None if settings.lights == "none" else lights, settings.samples)
    for position in range(len(yaws)) if settings.positions is None else settings.positions:
        index = (position, list(settings.views))
        cameras = rig.cameras(yaws[index], height, width, poses[index])
        shot = studio.shoot(cameras)
        for n, number in enumerate(settings.views):
            view = View(
                image=np.round(shot.images[n] * 255).astype(np.uint8),
                mask=shot.masks[n],
                inverse_depth=encode_depth(shot.depths[n]),
                intrinsics=cameras.intrinsics[n].numpy(),
                extrinsics=cameras.extrinsics[n].numpy(),
                matte=np.round(shot.alphas[n] * 255).astype(np.uint8),
            )
            write_view(workspace, position_name(name, position), number, view, settings.quality)
    if person.body_vertices is not None:
        write_body(workspace, name, person.body_vertices)


def write_view(phase: Path, folder: str, number: int, view: View, quality: int = 98) -> None:
    """Write one view of a subject.

    The JPEG has full chroma resolution. The mask has three equal channels, of which the authors' loader
    reads the first.

    Args:
        phase: folder of the phase, or a workspace.
        folder: name of the subject's position, ``<id>_<position>``.
        number: number of the view at its position.
        view: image, mask and camera; matte and inverse depth are optional.
        quality: quality of the JPEG, 1 to 100.
    """
    folders = {kind: phase / kind / folder for kind in ("img", "mask", "alpha", "depth", "parm")}
    for path in folders.values():
        path.mkdir(parents=True, exist_ok=True)
    Image.fromarray(view.image).save(folders["img"] / f"{number}.jpg", quality=quality, subsampling=0)
    mask = np.repeat(view.mask[..., None].astype(np.uint8) * 255, 3, axis=-1)
    Image.fromarray(mask).save(folders["mask"] / f"{number}.png", **_PNG)
    if view.matte is not None:
        Image.fromarray(view.matte).save(folders["alpha"] / f"{number}.png", **_PNG)
    if view.inverse_depth is not None:
        Image.fromarray(view.inverse_depth).save(folders["depth"] / f"{number}.png", **_PNG)
    np.save(folders["parm"] / f"{number}_intrinsic.npy", view.intrinsics.astype(np.float64))
    np.save(folders["parm"] / f"{number}_extrinsic.npy", view.extrinsics[:3].astype(np.float64))


def write_body(phase: Path, name: str, vertices: np.ndarray) -> None:
    """Write the vertices of a subject's body.

    Args:
        phase: folder of the phase, or a workspace.
        name: name of the subject.
        vertices: [n, 3], metres.
    """
    folder = phase / "smpl" / name
    folder.mkdir(parents=True, exist_ok=True)
    np.save(folder / "vertices.npy", vertices.astype(np.float32))


def render_people(
    root: Path,
    names: Mapping[str, Sequence[str]],
    source: PersonSource,
    rig: Rig,
    settings: RenderOptions,
    seed: int,
    workers: int | None = None,
) -> int:
    """Render people into ``root``; existing ones are kept.

    The process may be killed, repeated, or started twice: a second process waits for the first.

    Args:
        root: folder of the data set.
        names: names of people by phase.
        source: loads a person by name.
        rig: the cameras around each person.
        settings: renderings of each person.
        seed: seed of heights, yaws and lights.
        workers: number of processes; None: one per core; 0: only this one.

    Returns:
        Number of newly rendered people.

    Raises:
        InputError: ``root`` contains other data, a position is not on the rig, the script has no main
            guard, or people are invalid (raised after all others are rendered).
        RuntimeError: a rendering process died.
    """
    _require_main_guard()
    positions = settings.positions
    fits = positions is None or set(positions) <= set(range(rig.positions))
    require(fits, "data.render.positions", f"some of 0 to {rig.positions - 1}", positions)
    notes = Completeness(Path(root))
    made_with = identity(rig, settings, seed)
    check_settings(notes, made_with)
    if not any(notes.missing(phase, listed) for phase, listed in names.items()):
        return 0
    render = functools.partial(render_person, source, rig, settings, seed)
    with lock(notes.folder / "lock", wait=True) as held, name_folder_in_errors(notes.root):
        require(held, str(root), "one rendering at a time in a process", "another")
        check_settings(notes, made_with)  # another process may have stored others in the meantime
        _request(notes, names)
        todo = []
        for phase, listed in names.items():
            todo += [(phase, name) for name in notes.missing(phase, listed)]
        bad = _render_subjects(notes, todo, render, workers)
    if bad:
        raise InputError(f"{min(bad)} ({len(bad)} of {len(todo)} people are bad; the others are rendered)")
    return len(todo)


def _require_main_guard() -> None:
    """Reject a script whose workers, which import it, would render as well and wait for their parent
    forever."""
    is_imported = getattr(multiprocessing.current_process(), "_inheriting", False)
    expected = '`if __name__ == "__main__":` around what a script does, or data.render_workers=0'
    require(not is_imported, sys.argv[0], expected, None)


def _render_subjects(
    notes: Completeness,
    todo: Sequence[tuple[str, str]],
    render: Callable[[Path, str], str],
    workers: int | None,
) -> list[str]:
    """Render pairs of phase and name and move them to their place; returns why subjects are invalid."""
    workspaces = notes.folder / "tmp"
    shutil.rmtree(workspaces, ignore_errors=True)  # of killed runs
    folders = [workspaces / f"{phase}-{name}" for phase, name in todo]
    results = _map(render, folders, [name for _, name in todo], workers)
    progress = {"total": len(todo), "console": Console(stderr=True)}
    bad = []
    try:
        for index, why in track(results, f"rendering into {notes.root}", **progress):
            phase, name = todo[index]
            if why:
                bad.append(why)
                log.warning("%s is not rendered: %s", name, why)
            else:
                _publish(notes, phase, name, folders[index])
    finally:
        results.close()
        shutil.rmtree(workspaces, ignore_errors=True)
    return bad


def check_settings(notes: Completeness, settings: dict) -> None:
    """Store the settings in an empty data set, or check that a data set has the same ones.

    Args:
        notes: records of the data set.
        settings: nested plain data (:func:`identity`).

    Raises:
        InputError: the data set has other settings, or files that were not rendered here.
    """
    path = notes.folder / "settings.json"
    if not path.exists():
        is_empty = not notes.root.is_dir() or set(notes.root.iterdir()) <= {notes.folder}
        require(is_empty, str(notes.root), "an empty folder or one rendered here before", "other files")
        write_text_atomically(path, json.dumps(settings, indent=1))
    stored = flatten(read_json(path))
    settings = flatten(json.loads(json.dumps(settings)))  # tuples to lists, as they were stored
    for key in sorted(settings.keys() | stored.keys()):
        if settings.get(key) != stored.get(key):
            raise InputError(
                f"{path}: expected {key} = {settings.get(key)}; found {stored.get(key)} "
                "(render into another folder, or delete this one)"
            )


def _request(notes: Completeness, names: Mapping[str, Sequence[str]]) -> None:
    """Store the names of requested subjects by phase."""
    plan = notes.plan
    for phase, listed in names.items():
        plan[phase] = sorted({*plan.get(phase, []), *listed})
    write_text_atomically(notes.folder / "plan.json", json.dumps(plan, indent=1))


def _publish(notes: Completeness, phase: str, name: str, workspace: Path) -> None:
    """Move a subject's files to their place, then mark it as complete."""
    for kind in _KINDS:
        for source in sorted((workspace / kind).glob("*")):
            target = notes.root / phase / kind / source.name
            target.parent.mkdir(parents=True, exist_ok=True)
            if target.exists():  # left by a run that was killed between two moves
                shutil.rmtree(target)
            os.replace(source, target)
    marker = notes.marker(phase, name)
    marker.parent.mkdir(parents=True, exist_ok=True)
    marker.touch()
    shutil.rmtree(workspace)


def _map(
    render: Callable[[Path, str], str], folders: list[Path], names: list[str], workers: int | None
) -> Iterator[tuple[int, str]]:
    """Yield indices and results of ``render`` as completed by ``workers`` processes (None: one per core;
    0 or 1: only this one)."""
    workers = min(len(names), allowed_cores() if workers is None else workers)
    if workers < 2:
        yield from enumerate(map(render, folders, names))
        return
    compile_kernels()  # once, instead of in each worker
    use_known_start_method()
    context = multiprocessing.get_context("spawn")
    with (
        mock.patch.dict(os.environ, _ONE_THREAD),
        ProcessPoolExecutor(workers, context, initializer=start_worker) as pool,
    ):
        futures = {pool.submit(render, *each): i for i, each in enumerate(zip(folders, names, strict=True))}
        try:
            for future in as_completed(futures):
                yield futures[future], future.result()
        except BrokenProcessPool as error:
            raise RuntimeError("a rendering process died: memory ran out? (repeat to go on)") from error
        finally:
            pool.shutdown(cancel_futures=True)


def start_worker() -> None:
    """Initialise a worker: one thread, signals of a terminal or SLURM are left to the parent, and it exits
    with the parent."""
    torch.set_num_threads(1)
    for each in (signal.SIGINT, signal.SIGUSR1, signal.SIGUSR2):
        signal.signal(each, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """End this worker when its parent is killed (``kill``, ``kill -9``, the batch system)."""
    multiprocessing.parent_process().join()
    os._exit(1)
