"""A page that shows the newest capture, and how many captures a second."""

import contextlib
import math
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError, ThreadPoolExecutor, wait
from dataclasses import replace
from pathlib import Path

from ghgs_capture.capture import Capture
from ghgs_capture.export.reports import begin_files, end_files
from ghgs_capture.export.subject import ExportedSubject
from ghgs_capture.live import Arrived
from ghgs_capture.viewer.content import Content
from ghgs_capture.viewer.server import Viewer
from ghgs_lit.ply import write_ply
from ghgs_lit.types import Batch

_RECENT = 30  #: Instants over which run times are averaged, later ones with more weight


class Recording:
    """Numbered PLYs of what is shown, ``sequence/0000.ply`` and so on.

    They replace those of earlier runs.

    Args:
        directory: where ``sequence`` is written.

    Raises:
        InputError: a file of another origin is in the way.
    """

    def __init__(self, directory: Path):
        self.directory = directory
        self.instants = {}
        before = [f"sequence/{path.name}" for path in (directory / "sequence").glob("*")]
        begin_files(directory, before)
        for name in before:
            (directory / name).unlink()

    def add(self, subject: ExportedSubject) -> None:
        """Write the next PLY.

        Args:
            subject: what is shown.
        """
        name = f"sequence/{len(self.instants):04d}.ply"
        write_ply(subject.stored, self.directory / name)
        self.instants[name] = subject.name

    def end(self) -> None:
        """Write the report, from which a later run knows the files."""
        end_files(self.directory, [*self.instants], {"instants": [*self.instants.values()]})


class Pause:
    """``pause(seconds)`` waits; CancelledError once ``stopped`` is set.
    ``seconds``: length of all pauses."""

    def __init__(self):
        self.stopped = threading.Event()
        self.seconds = 0.0

    def __call__(self, seconds: float) -> None:
        begin = time.perf_counter()
        if self.stopped.wait(seconds):
            raise CancelledError
        self.seconds += time.perf_counter() - begin


def show_live(
    frames: Iterator[Arrived],
    pause: Pause,
    crop: Callable[[Capture], Batch],
    predict: Callable[[Batch], ExportedSubject],
    open_page: Callable[[Content], Viewer],
    recording: Recording | None = None,
    seconds: float = math.inf,
    delay: float = math.inf,
) -> None:
    """Show the newest capture until no more come or the time is over.

    Then, also after an error, close the page and print a summary.

    Args:
        frames: captures as they come; waits with ``pause``, which is stopped here.
        pause: waits between looks for a capture.
        crop: gives what the model sees; called in a thread, while the capture before is predicted.
        predict: gives what is shown.
        open_page: called with the first content.
        recording: gets what is shown; None: nothing is written.
        seconds: time after which this ends.
        delay: seconds after which a capture is dropped rather than shown.
    """
    page = None
    shown = 0
    dropped = 0
    late = 0
    line = "0 shown"
    times = {}
    try:
        with contextlib.closing(_read_ahead(frames, pause, crop, seconds)) as batches:
            for batch, missed, taken, reading in batches:
                begin = time.perf_counter()
                due = taken + delay
                dropped += missed
                subject = predict(batch) if time.monotonic() <= due else None
                if time.monotonic() > due:
                    late += 1
                    dropped += 1
                    line = f"{shown} shown, {dropped} dropped, {late} of them later than {delay:g} s"
                    continue
                seen = replace(batch, cameras=subject.cameras[None].to("cpu"))
                content = Content(subject.stored.to("cpu"), subject.up.cpu(), seen)
                predicted = time.perf_counter()
                if page is None:
                    page = open_page(content)
                    text = page.server.gui.add_markdown("")
                    last = begin
                opened = time.perf_counter()
                page.show(content)
                if recording is not None:
                    recording.add(subject)
                now = time.perf_counter()
                shown += 1
                stages = {"read and crop": reading, "predict": predicted - begin, "show": now - opened}
                for name, value in {"all": now - last, **stages}.items():
                    before = times.get(name, 0.0)
                    times[name] = before + (value - before) / min(shown, _RECENT)
                last = now
                rates = ", ".join(f"{name} {1 / times[name]:.3g}" for name in stages)
                lost = f"{dropped} dropped" + (f", {late} of them later than {delay:g} s" if late else "")
                line = f"{shown} shown, {lost}, {1 / times['all']:.3g} a second ({rates})"
                text.content = f"instant {subject.name}: {line}"
    finally:
        if page is not None:
            page.stop()
        if recording is not None:
            recording.end()
        print(line, flush=True)


def _read_ahead(
    frames: Iterator[Arrived], pause: Pause, crop: Callable[[Capture], Batch], seconds: float
) -> Iterator[tuple[Batch, int, float, float]]:
    """Read and crop captures in a thread, one ahead.

    Args:
        frames: captures as they come; waits with ``pause``.
        pause: stopped at the end.
        crop: gives what the model sees.
        seconds: time after which this ends.

    Yields:
        A batch, captures dropped before it, its time of arrival, and seconds of reading without
        pauses.
    """

    def following() -> tuple[Batch, int, float, float] | None:
        begin = time.perf_counter() - pause.seconds
        for capture, *known in frames:
            return crop(capture), *known, time.perf_counter() - pause.seconds - begin
        return None

    end = time.monotonic() + seconds
    with ThreadPoolExecutor(1) as pool:
        try:
            coming = pool.submit(following)
            while wait([coming], min(end - time.monotonic(), threading.TIMEOUT_MAX)).done:
                current = coming.result()
                if current is None or time.monotonic() > end:
                    break
                coming = pool.submit(following)
                yield current
        finally:
            pause.stopped.set()
