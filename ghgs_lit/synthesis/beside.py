"""People who are rendered beside training, which begins with the first of them; the others join it."""

import multiprocessing
import os
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

from ghgs_lit.data.completeness import Completeness
from ghgs_lit.data.layout import Layout
from ghgs_lit.errors import InputError
from ghgs_lit.synthesis.jobs import PersonSource, RenderOptions, render_people, start_worker
from ghgs_lit.synthesis.progress import Progress

# Training loses nothing to a process of this priority: it takes what its threads leave idle.
_NICE = 19
_running: dict[Path, multiprocessing.process.BaseProcess] = {}


class Joining(dict[str, tuple[int, ...]]):
    """``subjects`` of a layout of training: each look finds those who became whole since the last."""

    def __init__(self, layout: Layout, made: Completeness, names: Sequence[str]) -> None:
        super().__init__(layout.subjects)
        self._layout, self._made, self._names = layout, made, names
        layout.subjects = self

    def __iter__(self) -> Iterator[str]:
        if len(self) < len(self._names):
            whole = self._made.whole("train", self._names)
            if len(whole) > len(self):
                self._layout.find("train", whole)
        return super().__iter__()


def render_beside(
    root: Path, names: Sequence[str], source: PersonSource, rig: object, settings: RenderOptions, seed: int
) -> None:
    """Begin to render training people below ``root`` in a process that ends with this one; arguments as for
    :func:`ghgs_lit.synthesis.jobs.render_people`."""
    if not Progress(root).complete.missing("train", names) or (
        root in _running and _running[root].is_alive()
    ):
        return
    arguments = (root, {"train": list(names)}, source, rig, settings, seed)
    _running[root] = multiprocessing.get_context("spawn").Process(target=_render, args=arguments, daemon=True)
    _running[root].start()


def _render(*arguments: object) -> None:
    start_worker()
    os.nice(_NICE)
    try:
        render_people(*arguments, workers=0, shown=False)
    except (InputError, OSError) as error:
        print(f"training goes on with the people rendered so far: {error}", file=sys.stderr, flush=True)
