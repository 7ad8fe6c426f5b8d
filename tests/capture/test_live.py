"""A live view's captures: of a folder that is being written, and of videos;
no test waits for a clock."""

import itertools
import shutil

import pytest

from ghgs_capture.live import live_frames
from ghgs_lit.config.nodes import Calibration
from ghgs_lit.errors import InputError
from tests.helpers.figures import Figure
from tests.helpers.videos import mask_frames, number_of, numbered_frames, write_video


class Time:
    """A clock that goes on when somebody sleeps, and does what was planned meanwhile."""

    def __init__(self, *plans):
        self.now, self.plans = 0.0, list(plans)

    def clock(self):
        return self.now

    def sleep(self, seconds):
        self.now += seconds
        if self.plans:
            self.plans.pop(0)()


@pytest.fixture
def source(tmp_path):
    """An instant whose files can be put elsewhere, the calibration,
    and an empty folder for instants."""
    path = Figure().write(tmp_path / "source")
    shutil.copy(path, tmp_path / "again.json")
    shutil.move(path, tmp_path / "cameras.json")
    (tmp_path / "images").mkdir()
    return tmp_path


def put(place, instant, *names):
    """A plan: files of the source to an instant; all of them where none is named."""

    def plan():
        folder = place / "images" / instant
        folder.mkdir(exist_ok=True)
        for path in sorted((place / "source").iterdir()):
            if not names or path.name in names:
                shutil.copy(path, folder / path.name)

    return plan


def cut(place, instant, name):
    """A plan: half of a file."""

    def plan():
        put(place, instant)()
        content = (place / "source" / name).read_bytes()
        (place / "images" / instant / name).write_bytes(content[: len(content) // 2])

    return plan


def wait():
    """A plan: nothing."""


def arriving(place, time):
    return live_frames(place / "images", place / "cameras.json", idle=0.5, clock=time.clock, sleep=time.sleep)


def test_an_instant_counts_when_it_is_whole(source):
    """Not before the last camera's photograph and mask are there, nor while a file of it grows."""
    half = [f"cam{v}{end}" for v in (0, 1, 2) for end in (".png", "_mask.png")]
    time = Time(put(source, "000", *half), wait, wait, put(source, "000", "cam3.png"), wait, wait)
    time.plans += [cut(source, "000", "cam3.png"), put(source, "000")]
    frames = arriving(source, time)
    capture, dropped, _ = next(frames)
    assert (capture.name, dropped, len(capture.photographs)) == ("000", 0, 4)
    assert not time.plans
    assert list(frames) == []  # nothing comes any more


def test_instants_that_come_while_one_is_in_use_are_dropped(source):
    """The newest that can be read is taken; one that cannot be is dropped, too,
    when later ones come."""
    put(source, "8")()
    frames = arriving(source, Time())
    (source / "cameras.json").unlink()  # it is read once
    assert next(frames)[0].name == "8"
    for instant in ("9", "10", "11"):
        put(source, instant)()
    capture, dropped, _ = next(frames)
    assert (capture.name, dropped) == ("11", 2)
    cut(source, "12", "cam1.png")()
    assert list(frames) == []
    shutil.copy(source / "again.json", source / "cameras.json")
    frames = arriving(source, Time())
    capture, dropped, _ = next(frames)
    assert (capture.name, dropped) == ("11", 3)
    put(source, "13")()
    capture, dropped, _ = next(frames)
    assert (capture.name, dropped) == ("13", 1)


def test_videos_play_at_their_rate(source):
    """Frames that are late are dropped and counted; in time, none is."""
    figure = Figure()
    for camera, name in enumerate(figure.names):
        write_video(source / "videos" / f"{name}.mp4", numbered_frames(figure, camera, 6), fps=10)
        write_video(source / "masks" / f"{name}.mp4", mask_frames(figure, camera, 6), fps=10)
    time = Time()
    frames = live_frames(
        source / "videos", source / "cameras.json", source / "masks", clock=time.clock, sleep=time.sleep
    )
    for number in range(2):
        capture, dropped, _ = next(frames)
        assert (capture.name, dropped) == (f"{number:06d}", 0)
        assert time.now == pytest.approx(number / 10)
    time.now = 0.42  # the prediction took long
    capture, dropped, _ = next(frames)
    assert (capture.name, dropped, number_of(capture.photographs[0].image)) == ("000004", 2, 4)
    assert [(c.name, d) for c, d, _ in frames] == [("000005", 0)]
    assert time.now == pytest.approx(0.5)


def test_a_missing_folder_is_refused_at_once(source):
    with pytest.raises(InputError, match="nowhere: expected a folder"):
        live_frames(source / "nowhere", source / "cameras.json")
    assert list(itertools.islice(arriving(source, Time()), 1)) == []


@pytest.mark.parametrize("kind", [dict, Calibration])
def test_the_format_that_is_said_is_read(source, kind):
    """As options, or as plain data; the file alone would be taken for the package's own format."""
    calibration = kind(format="toml")
    with pytest.raises(InputError, match=r"cameras\.json: expected"):
        live_frames(source / "images", source / "cameras.json", calibration=calibration)
    assert live_frames(source / "images", source / "cameras.json", calibration=kind(format="ghgs"))
