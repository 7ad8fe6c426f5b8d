"""A short sequence of a figure: videos with masks, or a folder for each instant."""

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from imageio_ffmpeg import write_frames
from PIL import Image

from ghgs_capture.folder import CaptureFolder
from ghgs_capture.verbs.predict import read_captures
from tests.helpers.figures import Figure

SIDE, FRAMES, FPS = 64, 6, 10
FIGURE = Figure(height=SIDE, width=SIDE)


def frames_of(camera, count=FRAMES):
    return numbered_frames(FIGURE, camera, count)


def mask(camera):
    return FIGURE.masks[camera] * np.uint8(255)


def opened(place, images="images", masks="masks", **options):
    masks = None if masks is None else place / masks
    return CaptureFolder(place / images, place / "cameras.json", masks, **options)


def instants(place, count=FRAMES):
    """Write the sequence as a folder for each instant."""
    for number in range(count):
        folder = FIGURE.write(place / "instants" / f"{number:03d}").parent
        for camera, name in enumerate(FIGURE.names):
            Image.fromarray([*frames_of(camera)][number]).save(folder / f"{name}.png")
    return place / "instants"


def numbers(photographs):
    """The number in the corner of each photograph, by camera."""
    return {p.name: number_of(p.image) for p in photographs}


def all_numbers(folder):
    """Numbers of a sequence, by instant and camera."""
    return {capture.name: numbers(capture.photographs) for capture in read_captures(folder)}


def alike(number, names=FIGURE.names):
    return dict.fromkeys(names, number)


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
