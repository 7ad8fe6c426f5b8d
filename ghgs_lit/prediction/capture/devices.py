"""Frames of cameras, or of streams and files, that OpenCV opens: the newest of all, taken one after another.

One thread takes frames as they come, so that none waits in a camera's buffer; it decodes those alone that
somebody asks for.
"""

import threading
from collections.abc import Callable, Iterator, Mapping
from queue import SimpleQueue
from typing import Any

import numpy as np

from ghgs_lit.errors import InputError, require
from ghgs_lit.prediction.capture.frames import Frame

#: Seconds after which a frame is looked for again, and that closing waits for a camera.
_POLL, _PATIENCE = 0.002, 2.0


def opened(devices: Mapping[str, int | str]) -> dict[str, Any]:
    """OpenCV's captures by camera. InputError: one cannot be opened, or OpenCV is not installed.

    Args:
        devices: number of each camera, or address of a stream, or path of a video.
    """
    try:
        import cv2
    except ImportError:
        hint = "pip install opencv-python-headless"
        raise InputError(f"images: expected the package cv2 for cameras ({hint}); found none") from None
    found = {name: cv2.VideoCapture(device) for name, device in devices.items()}
    for name, device in devices.items():
        require(found[name].isOpened(), f"images.{name}", "a camera or stream that OpenCV opens", device)
    return found


def newest_frames(
    captures: Mapping[str, Any], least: int, clock: Callable[[], float], sleep: Callable[[float], None]
) -> Iterator[tuple[dict[str, Frame], int, float]]:
    """The newest frame of each camera that has one whenever they are asked for, how many times frames were
    taken and not asked for before, and when these were. It ends where fewer than ``least`` cameras go on, and
    releases them."""
    wanted, stopped, ready = threading.Event(), threading.Event(), SimpleQueue()
    wanted.set()  # the first frames that there are

    def take() -> None:
        passed = 0
        try:
            while not stopped.is_set():
                # All are taken before the first is decoded, which takes longer.
                shown = {name: capture for name, capture in captures.items() if capture.grab()}
                taken = clock()
                if len(shown) < least:
                    break
                if not wanted.is_set():
                    passed += 1
                    continue
                decoded = {name: capture.retrieve() for name, capture in shown.items()}
                frames = {name: _frame(name, image) for name, (is_read, image) in decoded.items() if is_read}
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
                sleep(_POLL)
            found = ready.get()
            if found is None:
                return
            yield found
            wanted.set()
    finally:
        stopped.set()
        thread.join(_PATIENCE)


def _frame(name: str, image: np.ndarray) -> Frame:
    """OpenCV's pixels are BGR."""
    return Frame(f"images.{name}", np.ascontiguousarray(image[..., ::-1]))
