"""Video files of a figure, whose frames contain their number."""

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from imageio_ffmpeg import write_frames

from tests.helpers.figures import Figure

#: The corner of frame n has n times this brightness; the figure does not cover it.
STEP = 40


def numbered_frames(figure: Figure, camera: int, count: int) -> Iterator[np.ndarray]:
    """Frames [h, w, 3] uint8, at most 7."""
    for number in range(count):
        picture = figure.images[camera].copy()
        picture[:12, :12] = STEP * number
        yield picture


def number_of(image: np.ndarray) -> int:
    """The number in the corner of a frame."""
    return round(float(image[2:9, 2:9].mean()) / STEP)


def write_video(path: Path, frames: Iterable[np.ndarray], fps: int = 10, **options: Any) -> None:
    """Write frames [h, w, 3] or [h, w] uint8; ``options`` are those of imageio-ffmpeg."""
    frames = [np.ascontiguousarray(frame) for frame in frames]
    path.parent.mkdir(parents=True, exist_ok=True)
    height, width = frames[0].shape[:2]
    pixels = "gray" if frames[0].ndim == 2 else "rgb24"
    options = {"macro_block_size": 2, "quality": 9, **options}
    writer = write_frames(str(path), (width, height), fps=fps, pix_fmt_in=pixels, **options)
    writer.send(None)
    for frame in frames:
        writer.send(frame)
    writer.close()
