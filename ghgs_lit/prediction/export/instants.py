"""Files of several instants together: a page that plays them, and numbered PLYs."""

import os
import shutil
import time
from collections.abc import Iterable
from functools import partial
from pathlib import Path

import numpy as np

from ghgs_lit.files import write_atomically
from ghgs_lit.prediction.export.page import COARSE, pack, page
from ghgs_lit.prediction.export.reports import begin_files, end_files, write_file
from ghgs_lit.prediction.export.subject import ExportedSubject, OutputOptions, exported_subject
from ghgs_lit.rendering import Renderer
from ghgs_lit.types import Batch, Prediction


class Instants:
    """Files of all instants together, beside their folders: for ``html`` ``viewer.html``, whose camera
    follows the subject's mean, smoothed over a second; for ``ply`` ``sequence/0000.ply`` and so on, which
    other programs import as a sequence.

    ``count``: largest number of instants. ``others``: names of further files, whose contents are set in the
    attribute before writing."""

    def __init__(self, count: int, options: OutputOptions, others: Iterable[str] = ()):
        self.count, self.options, self._seconds = count, options, 0.0
        self.others: dict[str, bytes] = dict.fromkeys(others, b"")
        self.folders: list[Path] = []
        self._first: ExportedSubject | None = None
        self._packed: list[bytes] = []
        self._means: list[np.ndarray] = []

    @property
    def files(self) -> list[str]:
        """Names of the files that may be written, below the directory of all instants."""
        numbered = [f"sequence/{number:04d}.ply" for number in range(self.count)]
        names = {"html": ["viewer.html"], "ply": numbered}
        made = [name for format in names if format in self.options.formats for name in names[format]]
        return [*made, *self.others]

    def add(self, folder: Path, batch: Batch, prediction: Prediction, renderer: Renderer) -> None:
        """Keep what the files need of the next instant. ``folder``: that of the instant's own files."""
        self.folders.append(folder)
        if "html" not in self.options.formats:
            return
        begin = time.perf_counter()
        subject = exported_subject(batch, prediction, renderer, self.options)
        self._first = self._first or subject
        self._packed.append(pack(subject.gaussians, self._first.pixel, self._first.center, COARSE))
        points = subject.body if len(subject.body) else subject.center[None]
        self._means.append(points.mean(0).cpu().numpy())
        self._seconds += time.perf_counter() - begin

    def write(self, directory: Path) -> list[Path]:
        """Write the files, after all instants are added and their own files written. Returns: the paths, the
        report last; none if ``formats`` has no such file. InputError: a file of other origin is in the way.
        """
        self.count, self.others = len(self.folders), {n: made for n, made in self.others.items() if made}
        names = self.files
        if not names:
            return []
        begin_files(directory, names)
        for path in (directory / "sequence").glob("[0-9]*.ply"):
            path.unlink()  # of an earlier, longer sequence: programs would play these, too
        contents = {name: partial(self.others.get, name) for name in self.others}
        contents["viewer.html"] = self._page
        seconds, sources = {"code": self._seconds}, iter(self.folders)
        for name in names:
            if name in contents:
                seconds[f"write {name}"] = write_file(directory / name, contents[name])
            else:
                write_atomically(directory / name, partial(_link, next(sources) / "gaussians.ply"))
        report = {"instants": [folder.name for folder in self.folders], "seconds": seconds}
        return end_files(directory, names, report)

    def _path(self) -> np.ndarray:
        reach = self.options.fps // 2
        # Odd reflection at the ends: a steady walk stays steady.
        padded = np.pad(np.stack(self._means), ((reach, reach), (0, 0)), "reflect", reflect_type="odd")
        weights = np.hanning(2 * reach + 3)[1:-1]
        windows = np.lib.stride_tricks.sliding_window_view(padded, len(weights), axis=0)
        means = windows @ (weights / weights.sum())
        return means - means[0]

    def _page(self) -> bytes:
        name, path = self.folders[0].parent.name, self._path().tolist()
        return page(self._first, name, self._packed, path, self.options.fps).encode()


def _link(source: Path, target: Path) -> None:
    try:
        os.link(source, target)
    except OSError:
        shutil.copyfile(source, target)
