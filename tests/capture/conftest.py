"""Fixture with videos of a figure on disk."""

import shutil

import pytest

from tests.helpers.sequences import FIGURE, FRAMES, frames_of, mask
from tests.helpers.videos import write_video


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """Write four videos with masks, and the calibration."""
    place = tmp_path_factory.mktemp("videos")
    for camera, name in enumerate(FIGURE.names):
        write_video(place / "images" / f"{name}.mp4", frames_of(camera))
        write_video(place / "masks" / f"{name}.mp4", [mask(camera)] * FRAMES)
    shutil.move(FIGURE.write(place / "still"), place / "cameras.json")
    return place


@pytest.fixture
def place(written, tmp_path):
    return shutil.copytree(written, tmp_path / "place")
