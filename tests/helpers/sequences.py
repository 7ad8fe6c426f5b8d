"""A short sequence of a figure: videos with masks, or a folder for each instant."""

import numpy as np
from PIL import Image

from ghgs_capture.folder import CaptureFolder
from ghgs_capture.verbs.predict import read_captures
from tests.helpers.figures import Figure
from tests.helpers.videos import number_of, numbered_frames

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
