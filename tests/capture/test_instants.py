"""Instants of a sequence: selection, and errors in some of them."""

import shutil

import pytest
from PIL import Image

from ghgs_capture import camera_report
from ghgs_capture.folder import CaptureFolder
from ghgs_capture.verbs.photographs import check_cameras
from ghgs_capture.verbs.predict import read_captures
from ghgs_lit.errors import InputError
from tests.helpers.captures import truncate
from tests.helpers.sequences import (
    FIGURE,
    FRAMES,
    alike,
    all_numbers,
    frames_of,
    instants,
    mask,
    opened,
)
from tests.helpers.videos import write_video


@pytest.mark.parametrize(
    ("part", "chosen"),
    [
        ({"start": 1, "stop": 5, "step": 2}, (1, 3)),
        ({"start": -2}, (4, 5)),
        ({"step": 5}, (0, 5)),
        ({"stop": -4}, (0, 1)),
    ],
)
@pytest.mark.parametrize("kind", ["videos", "instants"])
def test_a_part_of_a_sequence(place, part, chosen, kind):
    folder = opened(place, sequence=part) if kind == "videos" else None
    folder = folder or CaptureFolder(instants(place), place / "cameras.json", sequence=part)
    assert [set(found.values()) for found in all_numbers(folder).values()] == [{n} for n in chosen]
    assert [int(name) for name in folder.instants] == list(chosen)


def test_a_single_instant_of_a_sequence_is_refused_as_one(place):
    folder = instants(place)
    truncate(folder / "002" / "cam1.png")
    one = CaptureFolder(folder, place / "cameras.json", sequence={"start": 2, "stop": 3})
    with pytest.raises(InputError, match=r"cam1\.png: expected a readable image"):
        list(read_captures(one))


def test_a_photograph_missing_in_a_folder_of_cameras(place):
    folder = instants(place)
    for name in FIGURE.names:
        (place / "by_camera" / name).mkdir(parents=True)
        for instant in sorted(folder.iterdir()):
            shutil.copy(instant / f"{name}.png", place / "by_camera" / name / f"{instant.name}.png")
    for camera, name in enumerate(FIGURE.names):
        for number in range(FRAMES):
            path = place / "still_masks" / name / f"{number:03d}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            Image.fromarray(FIGURE.masks[camera]).save(path)
    (place / "by_camera" / "cam0" / "000.png").unlink()
    found = all_numbers(opened(place, "by_camera", "still_masks"))
    assert found["000"] == alike(0, ["cam1", "cam2", "cam3"])
    assert found["001"] == alike(1)


def test_instants_and_their_numbers_are_in_order_without_zeros_before(place):
    folder = place / "counted"
    for number in (10, 9, 1):
        for camera, name in enumerate(FIGURE.names):
            (folder / f"frame{number}").mkdir(parents=True, exist_ok=True)
            (place / "by_camera" / name).mkdir(parents=True, exist_ok=True)
            Image.fromarray(FIGURE.images[camera]).save(folder / f"frame{number}" / f"{name}.png")
            shutil.copy(
                folder / f"frame{number}" / f"{name}.png", place / "by_camera" / name / f"frame{number}.png"
            )
    for images in ("counted", "by_camera"):
        assert opened(place, images).instants == ["frame1", "frame9", "frame10"]


REFUSED = {
    "offsets of unknown cameras": ({"sync": {"cam9": 1}}, r"sequence\.sync: .*cam0, cam1.*found \['cam9'\]"),
    "offsets of half frames": ({"sync": {"cam1": 0.5}}, r"sequence\.sync: .*whole numbers of frames"),
    "offsets beyond the videos": ({"sync": {"cam1": 6}}, r"sequence\.sync: .*frames that all videos show"),
    "nothing after the end": ({"start": 6}, r"sequence\.start: expected a part of 6 instants; found"),
    "nothing before the start": ({"start": 3, "stop": 2}, "from 3 to 2"),
    "no step": ({"step": 0}, r"sequence\.step: expected an integer >= 1; found 0"),
    "no such key": ({"skip": 1}, "sequence.skip: expected one of .*found 'skip'"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_sequences_that_are_refused(place, name):
    part, line = REFUSED[name]
    with pytest.raises(InputError, match=line):
        opened(place, sequence=part)


def test_photographs_are_not_synchronised(place):
    with pytest.raises(InputError, match=r"sequence\.sync: expected null for photographs"):
        CaptureFolder(instants(place, 2), place / "cameras.json", sequence={"sync": {"cam0": 1}})


def test_cameras_are_refused_where_no_instant_agrees(place, capsys):
    """Cameras that are exchanged in the first three instants, which a later one contradicts."""
    for folder, frames in (("images", frames_of), ("masks", lambda camera: [mask(camera)] * FRAMES)):
        one, other = ([*frames(camera)] for camera in (0, 1))
        write_video(place / folder / "cam0.mp4", other[:3] + one[3:])
        write_video(place / folder / "cam1.mp4", one[:3] + other[3:])
    check_cameras(opened(place))
    assert "cameras and masks agree" in capsys.readouterr().out
    with pytest.raises(InputError, match=r"\{cam0: cam1, cam1: cam0\}"):
        check_cameras(opened(place, sequence={"stop": 2}))


def test_cameras_that_no_instant_can_check_are_said(place, capsys, monkeypatch):
    def unreadable(*_):
        raise InputError("broken")

    monkeypatch.setattr(camera_report, "diagnose", unreadable)
    check_cameras(opened(place))
    assert "cameras are not checked: none of the instants" in capsys.readouterr().out
