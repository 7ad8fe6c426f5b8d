"""Cameras that OpenCV opens: the newest frames of all, what is dropped, and how they end."""

import sys
import threading
import time
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from ghgs_capture.live import live_frames, newest_frames, opened
from ghgs_lit.errors import InputError
from tests.helpers.figures import Figure
from tests.helpers.videos import STEP, number_of, numbered_frames, write_video

FIGURE = Figure()
BROKEN = 9


class Camera:
    """In place of ``cv2.VideoCapture``: its frames carry their number,
    and come when the test says so."""

    def __init__(self, device):
        self.device, self.taken, self.waits, self.coming = device, -1, 0, threading.Semaphore(0)
        self.empty, self.is_free, self.is_lost, self.is_released = 0, False, False, False

    def isOpened(self):
        return self.device != BROKEN

    def grab(self):
        self.waits += 1
        if not self.is_free and not self.coming.acquire(timeout=20):
            return False
        self.taken += 1
        return not self.is_lost

    def retrieve(self):
        image = (FIGURE.backgrounds if self.taken < self.empty else FIGURE.images)[self.device].copy()
        if self.taken >= self.empty:
            image[:12, :12] = STEP * self.taken % 250, 0, 0
        return True, image[..., ::-1]

    def release(self):
        self.is_released = True


class Rig(SimpleNamespace):
    """Cameras, and where their calibration and backgrounds are."""

    def frames(self, **options):
        """Live captures of these cameras."""
        options = {"images": self.devices, "cameras": self.cameras, "backgrounds": self.behind, **options}
        return live_frames(**options, clock=lambda: 7.0, sleep=self.sleep)

    def sleep(self, seconds):
        """Whoever waits first lets a frame of each camera come."""
        if self.is_due:
            self.is_due = False
            for camera in self.made:
                camera.coming.release()
        time.sleep(seconds)

    def following(self, frames):
        self.is_due = True
        return next(frames, None)

    def come(self, count):
        """So many frames come while nobody waits."""
        for camera in self.made:
            camera.coming.release(count)
        goal, end = self.made[0].waits + count, time.monotonic() + 20
        while self.made[0].waits < goal:
            assert time.monotonic() < end
            time.sleep(0.001)


@pytest.fixture
def rig(tmp_path, monkeypatch):
    made = []
    fake = SimpleNamespace(VideoCapture=lambda device: made.append(Camera(device)) or made[-1])
    monkeypatch.setitem(sys.modules, "cv2", fake)
    cameras = FIGURE.write(tmp_path, masks=False)
    (tmp_path / "behind").mkdir()
    for name, image in zip(FIGURE.names, FIGURE.backgrounds, strict=True):
        Image.fromarray(image).save(tmp_path / "behind" / f"{name}.png")
    devices = {name: number for number, name in enumerate(FIGURE.names)}
    yield Rig(made=made, cameras=cameras, behind=tmp_path / "behind", devices=devices, is_due=False)
    for camera in made:  # no thread waits for frames any more
        camera.is_free = camera.is_lost = True
        camera.coming.release()


def red_of(photograph):
    return round(float(photograph.image[2:9, 2:9, 0].mean()) / STEP)


def test_the_newest_frames_of_all_cameras(rig):
    """Frames that come meanwhile are dropped and counted;
    colours are right, and masks the background's."""
    frames = rig.frames()
    first = rig.following(frames)
    assert (first.capture.name, first.dropped, first.taken) == ("000000", 0, 7.0)
    rig.come(3)
    second = rig.following(frames)
    assert (second.capture.name, second.dropped) == ("000004", 3)
    assert [red_of(p) for p in second.capture.photographs] == [4] * 4
    for photograph, image, mask in zip(second.capture.photographs, FIGURE.images, FIGURE.masks, strict=True):
        np.testing.assert_array_equal(photograph.image[20:], image[20:])
        assert (photograph.mask == mask)[20:].mean() > 0.98


def test_a_camera_that_ends_is_left_out_and_all_end_with_the_next(rig):
    frames = rig.frames()
    rig.following(frames)
    rig.made[1].is_lost = True
    assert [p.name for p in rig.following(frames).capture.photographs] == ["cam0", "cam2", "cam3"]
    rig.made[2].is_lost = True
    assert rig.following(frames) is None
    assert all(camera.is_released for camera in rig.made)


def test_whoever_stops_releases_the_cameras(rig):
    frames = rig.frames()
    rig.following(frames)
    for camera in rig.made:
        camera.is_free = True
        camera.coming.release()
    frames.close()
    assert all(camera.is_released for camera in rig.made)


def test_frames_without_a_subject_are_left_out_and_said_once(rig, capsys):
    frames = rig.frames()
    for camera in rig.made:
        camera.empty, camera.is_free = 5, True
    found = next(frames)
    assert found.dropped == int(found.capture.name) >= 5
    lines = capsys.readouterr().out.splitlines()
    assert [line.split(":")[0] for line in lines] == ["instant 000000 is left out"]
    frames.close()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"images": {"cam0": 0, "cam1": BROKEN}}, r"images\.cam1: expected a camera or stream that OpenCV"),
        ({"images": {"cam0": 0, "left": 1}}, "found left"),
        ({"backgrounds": None}, "masks: expected backgrounds=<folder> or segment=rembg"),
        ({"masks": "."}, "masks: expected backgrounds=<folder> or segment=rembg"),
        ({"sequence": {"step": 2}}, "sequence: expected all instants of cameras"),
    ],
)
def test_cameras_that_are_refused(rig, change, message):
    with pytest.raises(InputError, match=message):
        rig.frames(**change)


def test_without_opencv_one_line_says_what_is_missing(rig, monkeypatch):
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(InputError, match="images: expected the package cv2 for cameras"):
        rig.frames()


def test_opencv_reads_files(tmp_path):
    """Its own captures: frames of all files have one number, none comes twice,
    and all end together."""
    pytest.importorskip("cv2")
    paths = {name: tmp_path / f"{name}.mp4" for name in FIGURE.names}
    for camera, path in enumerate(paths.values()):
        write_video(path, numbered_frames(FIGURE, camera, 6))
    found = [
        *newest_frames(opened({n: str(path) for n, path in paths.items()}), 3, time.monotonic, time.sleep)
    ]
    numbers = [{number_of(frame.image) for frame in frames.values()} for frames, _, _ in found]
    assert numbers[0] == {0}
    assert all(len(each) == 1 for each in numbers)
    places = [min(each) for each in numbers]
    assert places == sorted(set(places))
    assert [passed for _, passed, _ in found][1:] == [b - a - 1 for a, b in pairwise(places)]
    image = next(iter(found[0][0].values())).image
    assert np.abs(image[20:].astype(int) - FIGURE.images[0][20:]).mean() < 12
