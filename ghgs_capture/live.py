"""Live captures: instants of a folder that is being written, videos at their own rate,
or cameras."""

import itertools
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from queue import SimpleQueue
from typing import Any, NamedTuple

import numpy as np

from ghgs_capture.capture import Capture
from ghgs_capture.folder import MIN_PHOTOGRAPHS, CaptureFolder
from ghgs_capture.formats import CameraFile, read_cameras
from ghgs_capture.frames import Frame
from ghgs_capture.photographs import (
    by_camera,
    camera_named,
    composed_names,
    counted,
    images_in,
)
from ghgs_capture.videos import SUFFIXES
from ghgs_lit.config.nodes import Calibration, SequenceOptions
from ghgs_lit.errors import InputError, require

#: Seconds between looks for a frame and for a folder, and of waiting for a camera at the end.
_FRAME_POLL = 0.002
_FOLDER_POLL = 0.02
_PATIENCE = 2.0


def opened(devices: Mapping[str, int | str]) -> dict[str, Any]:
    """Open cameras and streams with OpenCV.

    Args:
        devices: number of a device, address of a stream or path of a video, by camera.

    Returns:
        OpenCV's captures by camera.

    Raises:
        InputError: one cannot be opened, or OpenCV is not installed.
    """
    try:
        import cv2
    except ImportError:
        hint = "pip install opencv-python-headless"
        raise InputError(f"images: expected the package cv2 for cameras ({hint}); found none") from None
    captures = {name: cv2.VideoCapture(device) for name, device in devices.items()}
    for name, device in devices.items():
        require(captures[name].isOpened(), f"images.{name}", "a camera or stream that OpenCV opens", device)
    return captures


def newest_frames(
    captures: Mapping[str, Any], least: int, clock: Callable[[], float], sleep: Callable[[float], None]
) -> Iterator[tuple[dict[str, Frame], int, float]]:
    """The newest frames whenever they are asked for.

    A thread takes frames as they come, so that none waits in a camera's buffer, and decodes only
    those that are asked for. Ends, and releases the cameras, where fewer than ``least`` give
    frames.

    Args:
        captures: OpenCV's captures by camera.
        least: number of cameras that must go on.
        clock: tells seconds.
        sleep: waits so many seconds.

    Yields:
        Frames by camera, how many were taken before and not asked for, and when they were taken, by
        the clock.
    """
    wanted = threading.Event()
    stopped = threading.Event()
    ready = SimpleQueue()
    wanted.set()  # the first frames

    def take() -> None:
        passed = 0
        try:
            while not stopped.is_set():
                # All are grabbed before decoding, which takes longer.
                shown = {name: capture for name, capture in captures.items() if capture.grab()}
                taken = clock()
                if len(shown) < least:
                    break
                if not wanted.is_set():
                    passed += 1
                    continue
                decoded = {name: capture.retrieve() for name, capture in shown.items()}
                # OpenCV's pixels are BGR.
                frames = {
                    name: Frame(f"images.{name}", np.ascontiguousarray(image[..., ::-1]))
                    for name, (is_read, image) in decoded.items()
                    if is_read
                }
                wanted.clear()
                ready.put((frames, passed, taken))
                passed = 0
        finally:
            for capture in captures.values():
                capture.release()
            ready.put(None)

    thread = threading.Thread(target=take, daemon=True)
    thread.start()
    try:
        while True:
            while ready.empty():
                sleep(_FRAME_POLL)
            newest = ready.get()
            if newest is None:
                return
            yield newest
            wanted.set()
    finally:
        stopped.set()
        thread.join(_PATIENCE)


class Arrived(NamedTuple):
    """A capture, how many were dropped since the one before,
    and its time of arrival by the clock."""

    capture: Capture
    dropped: int
    taken: float


def live_frames(
    images: str | Path | Mapping[str, int | str],
    cameras: str | Path,
    masks: str | Path | None = None,
    idle: float | None = None,
    clock: Callable[[], float] = time.monotonic,
    sleep: Callable[[float], None] = time.sleep,
    **options: Any,
) -> Iterator[Arrived]:
    """The newest capture whenever one is asked for;
    others, and those that cannot be read, are dropped.

    Args:
        images: a folder of videos, played at their own rate; or of instants, each a folder that
            counts once it has a photograph of every camera and none of its files grows any more. Or
            what OpenCV opens, by camera: numbers of devices, addresses of streams; ``options`` then
            says where masks come from, and at least ``MIN_PHOTOGRAPHS`` cameras must go on.
        cameras: the calibration, in one of :data:`ghgs_capture.formats.FORMATS`.
        masks: a folder laid out as ``images``; None: as for :class:`CaptureFolder`.
        idle: seconds without a new instant after which a folder of instants ends; None: never.
        clock: tells seconds.
        sleep: waits so many seconds.
        options: as for :class:`CaptureFolder`.

    Returns:
        An iterator of captures, which waits for the next one.

    Raises:
        InputError: the calibration, a video, a camera or the folder is missing or wrong.
    """
    calibration = Calibration.read(options.get("calibration", {}), "calibration")
    part = SequenceOptions.read(options.get("sequence", {}), "sequence")
    if is_folder := not isinstance(images, Mapping):
        folder = Path(images).expanduser()
        require(folder.is_dir(), str(images), "a folder", "no such folder")
        if images_in(folder, SUFFIXES):
            return _played(CaptureFolder(folder, cameras, masks, **options), clock, sleep)
    expected = f"all instants of {'a folder that is being written' if is_folder else 'cameras'}"
    require(part == SequenceOptions(), "sequence", expected, dict(part))
    stored = read_cameras(cameras, calibration.format)
    if not is_folder:
        devices = by_camera(
            Path("images"), {str(n): device for n, device in images.items()}, stored.cameras, {}
        )
        expected = "backgrounds=<folder> or segment=rembg for masks of cameras"
        is_told = masks is None and (options.get("backgrounds") or options.get("segment"))
        require(bool(is_told), "masks", expected, masks)
        least = min(MIN_PHOTOGRAPHS, len(devices))
        return _watched(newest_frames(opened(devices), least, clock, sleep), stored, options)
    names = composed_names(calibration.names)
    places = [folder] if masks is None else [folder, Path(masks).expanduser()]

    def read(name: str) -> Capture:
        one = CaptureFolder(folder / name, stored, None if masks is None else places[1] / name, **options)
        return Capture(name, one.photographs(one.instants[0]))

    def is_whole(name: str) -> bool:
        photographs = images_in(folder / name)
        return stored.cameras.keys() <= {camera_named(n, stored.cameras, names) for n in photographs}

    return _arriving(places, is_whole, read, idle, clock, sleep)


def _watched(
    frames: Iterator[tuple[dict[str, Frame], int, float]], stored: CameraFile, options: Mapping[str, Any]
) -> Iterator[Arrived]:
    """Captures of cameras; a line says once why instants cannot be read."""
    number = -1
    dropped = 0
    last_error = ""
    for images, passed, taken in frames:
        number = number + passed + 1
        dropped += passed
        try:
            capture = Capture(f"{number:06d}", CaptureFolder(images, stored, **options).photographs(""))
        except InputError as error:
            dropped += 1
            if str(error) != last_error:
                last_error = str(error)
                print(f"instant {number:06d} is left out: {last_error}", flush=True)
            continue
        yield Arrived(capture, dropped, taken)
        dropped = 0


def _played(
    folder: CaptureFolder, clock: Callable[[], float], sleep: Callable[[float], None]
) -> Iterator[Arrived]:
    """Captures of videos at the time at which each frame is due."""
    names = folder.instants
    first = next(iter(folder.paths[names[0]].values())).video.video
    # Instants are named by the frame of the first camera.
    due = (np.array([int(name) for name in names]) - int(names[0])) / first.rate
    begin = clock()
    place = 0
    dropped = 0
    while place < len(names):
        newest = max(place, int(np.searchsorted(due, clock() - begin, side="right")) - 1)
        dropped += newest - place
        place = newest + 1
        try:
            capture = Capture(names[newest], folder.photographs(names[newest]))
        except InputError:
            dropped += 1
            continue
        sleep(max(float(due[newest]) - (clock() - begin), 0.0))
        yield Arrived(capture, dropped, begin + float(due[newest]))
        dropped = 0


def _arriving(
    places: list[Path],
    is_whole: Callable[[str], bool],
    read: Callable[[str], Capture],
    idle: float | None,
    clock: Callable[[], float],
    sleep: Callable[[float], None],
) -> Iterator[Arrived]:
    """Captures of folders that are written meanwhile.

    Args:
        places: the folder of instants, and that of their masks if it is another.
        is_whole: whether an instant, by name, has a photograph of every camera.
        read: gives the capture of an instant, by name.
        idle: seconds without a new instant after which this ends; None: never.
        clock: tells seconds.
        sleep: waits so many seconds.

    Yields:
        The newest whole instant that does not grow any more and is later than those before.
    """
    done = []
    before = {}
    unread = {}
    last = clock()
    while idle is None or clock() - last < idle:
        folders = (path.name for path in places[0].iterdir() if path.is_dir() and path.name[0] != ".")
        sizes = {}
        for name in folders:
            if counted(name) > done:
                sizes[name] = [_sizes(place / name) for place in places]
        still = [name for name, size in sizes.items() if before.get(name) == size != unread.get(name)]
        newest = max(filter(is_whole, still), key=counted, default=None)
        before = sizes
        if newest is None:
            sleep(_FOLDER_POLL)
            continue
        try:
            capture = read(newest)
        except InputError:  # until its files change: masks may come later
            unread[newest] = sizes[newest]
            continue
        done = counted(newest)
        last = clock()
        folders = [place / newest for place in places if (place / newest).is_dir()]
        files = itertools.chain.from_iterable(folder.iterdir() for folder in folders)
        age = max(time.time() - max(path.stat().st_ctime for path in files), 0.0)
        yield Arrived(capture, sum(counted(name) < done for name in sizes), last - age)


def _sizes(folder: Path) -> dict[str, int]:
    """Bytes of each file; -1 for one that vanishes meanwhile."""
    sizes = {}
    for path in folder.iterdir() if folder.is_dir() else ():
        try:
            sizes[path.name] = path.stat().st_size
        except FileNotFoundError:
            sizes[path.name] = -1
    return sizes
