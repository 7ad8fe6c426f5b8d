"""People who are rendered beside training, which waits for the first ones only."""

import multiprocessing
import os
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

from ghgs_lit.data.layout import Completeness, Layout
from ghgs_lit.errors import InputError
from ghgs_people.jobs import PersonSource, RenderOptions, render_people, start_worker

# A process of this priority only takes time that training leaves idle.
_NICE = 19
_running: dict[Path, multiprocessing.process.BaseProcess] = {}


class Joining(dict[str, tuple[int, ...]]):
    """``subjects`` of a training layout; iterating adds those of ``names`` that have
    become complete.

    Args:
        layout: of the training people that are complete so far;
            its ``subjects`` become this mapping.
        names: all training people, complete or not.
    """

    def __init__(self, layout: Layout, names: Sequence[str]) -> None:
        super().__init__(layout.subjects)
        self._layout = layout
        self._names = names
        self._progress = Completeness(layout.root)
        layout.subjects = self

    def __iter__(self) -> Iterator[str]:
        if len(self) < len(self._names):
            complete = self._progress.whole("train", self._names)
            if len(complete) > len(self):
                self._layout.find("train", complete)
        return super().__iter__()


def render_beside(
    root: Path, names: Sequence[str], source: PersonSource, rig: object, settings: RenderOptions, seed: int
) -> None:
    """Start to render training people in a process that ends with this one.

    Nothing starts while such a process runs for ``root``, or where nobody is missing.

    Args:
        root: folder of the data set.
        names: training people.
        source: loads a person by name.
        rig: the cameras around each person, a :class:`ghgs_people.rig.Rig` or
            :class:`ghgs_people.capture_rig.CaptureRig`.
        settings: what is rendered of each person.
        seed: of heights, yaws and lights.
    """
    running = root in _running and _running[root].is_alive()
    if running or not Completeness(root).missing("train", names):
        return
    arguments = (root, {"train": list(names)}, source, rig, settings, seed)
    _running[root] = multiprocessing.get_context("spawn").Process(target=_render, args=arguments, daemon=True)
    _running[root].start()


def _render(*arguments: object) -> None:
    """Render in a process of lowest priority; bad people are named on standard error.

    Args:
        arguments: those of :func:`ghgs_people.jobs.render_people` from ``root`` to ``seed``.
    """
    start_worker()
    os.nice(_NICE)
    try:
        render_people(*arguments, workers=0, shown=False)
    except (InputError, OSError) as error:
        print(f"training goes on with the people rendered so far: {error}", file=sys.stderr, flush=True)
