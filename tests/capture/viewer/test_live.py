"""The page of a live view: the newest instant is shown, what was shown is kept,
and all ends cleanly."""

import dataclasses
import json
import math
import threading
import time
import urllib.error
import urllib.request
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from ghgs_capture.capture import Capture
from ghgs_capture.export import OutputOptions
from ghgs_capture.export.subject import exported_subject
from ghgs_capture.live import Arrived, live_frames
from ghgs_capture.prediction import predict
from ghgs_capture.viewer.live import Pause, Recording, show_live
from ghgs_capture.viewer.server import Viewer
from ghgs_lit.errors import InputError
from ghgs_lit.ply import ply_bytes, read_ply
from ghgs_lit.rendering import Renderer
from ghgs_lit.weights.checkpoint import write_checkpoint
from tests.helpers.figures import Figure
from tests.helpers.models import config, make_model
from tests.helpers.splats import body
from tests.helpers.training import Standin, example_batch
from tests.helpers.verbs import ghgs
from tests.helpers.videos import mask_frames, numbered_frames, write_video

PORT = 18280  # the next free one is taken


def crop(capture):
    return dataclasses.replace(example_batch(1), targets=None, subjects=(capture.name,))


def predicted(batch):
    """As many Gaussians as the name of the instant says."""
    prediction = dataclasses.replace(Standin()(batch), gaussians=body(int(batch.subjects[0]), 60))
    return exported_subject(batch, prediction, Renderer(), OutputOptions())


def instants(*names, dropped=0, taken=math.inf):
    return iter([Arrived(Capture(name, ()), dropped, taken) for name in names])


class Page:
    """A page that keeps what it shows, and says when it is closed."""

    def __init__(self, content=None):
        self.seen, self.is_open, self.text = [], True, SimpleNamespace(content="")
        self.server = SimpleNamespace(gui=SimpleNamespace(add_markdown=lambda _: self.text))

    def show(self, content):
        self.seen.append(len(content.gaussians))

    def stop(self):
        self.is_open = False


def test_the_newest_instant_is_shown_and_the_page_closed(capsys):
    pages = []

    def opened(content):
        pages.append(Viewer(content, port=PORT, layers=False))
        return pages[0]

    show_live(instants("300", "500", "40", dropped=2), Pause(), crop, predicted, opened)
    (page,) = pages
    expected = predicted(crop(Capture("40", ()))).stored.means
    assert torch.equal(page.content.gaussians.means, expected)
    assert len(page.splats.buffer) == 40
    assert not {"/cameras", "/points", "/hull"} & set(page.server.scene._handle_from_node_name)
    line = capsys.readouterr().out.splitlines()[-1]
    assert line.startswith("3 shown, 6 dropped, ")
    assert all(part in line for part in (" a second (read and crop ", ", predict ", ", show "))
    with pytest.raises(urllib.error.URLError):
        urllib.request.urlopen(page.address, timeout=5)


def test_a_page_shows_other_gaussians_to_visitors_where_they_are():
    """All of them, also where there were fewer at first, but no more than a visitor wants."""
    contents = []
    show_live(instants("30"), Pause(), crop, predicted, lambda content: contents.append(content) or Page())
    viewer = Viewer(contents[0], port=PORT, layers=False)
    try:
        start = tuple(viewer.server.initial_camera.position)
        viewer.show(dataclasses.replace(contents[0], gaussians=body(50, 60)))
        assert len(viewer.splats.buffer) == 50
        viewer.count.value = 7
        viewer.show(dataclasses.replace(contents[0], gaussians=body(60, 60)))
        assert len(viewer.splats.buffer) == 7
        assert tuple(viewer.server.initial_camera.position) == start
    finally:
        viewer.stop()


def test_the_next_capture_is_read_and_cropped_meanwhile(capsys):
    """In another thread: it is there before the prediction ends."""
    read, page = [threading.Event() for _ in range(2)], Page()

    def cropped(capture):
        read[int(capture.name) - 1].set()
        return crop(capture)

    def waiting(batch):
        assert read[1].wait(20)
        return predicted(batch)

    show_live(instants("1", "2"), Pause(), cropped, waiting, lambda _: page)
    assert page.seen == [1, 2]
    assert page.text.content.startswith("instant 2: 2 shown, 0 dropped, ")
    assert capsys.readouterr().out in page.text.content + "\n"


def test_what_is_older_than_the_delay_is_dropped_counted_and_said(capsys, monkeypatch):
    """Before it is predicted, or after where that takes too long; what comes in time is shown."""
    clock, page, asked = SimpleNamespace(now=100.0), Page(), []
    times = SimpleNamespace(monotonic=lambda: clock.now, perf_counter=time.perf_counter)
    monkeypatch.setattr("ghgs_capture.viewer.live.time", times)

    def slowly(batch):
        asked.append(batch.subjects[0])
        clock.now += 1.0
        return predicted(batch)

    frames = [*instants("30", taken=97.9), *instants("40", taken=98.5)]
    frames += instants("50", taken=99.5, dropped=3)
    show_live(iter(frames), Pause(), crop, slowly, lambda _: page, delay=2.0)
    assert asked == ["40", "50"]
    assert capsys.readouterr().out == "0 shown, 6 dropped, 3 of them later than 2 s\n"
    clock.now = 100.0
    show_live(iter(frames[::2]), Pause(), crop, slowly, lambda _: page, delay=2.0)
    assert page.seen == [50]
    line = capsys.readouterr().out.splitlines()[-1]
    assert line.startswith("1 shown, 4 dropped, 1 of them later than 2 s, ")
    assert page.text.content == f"instant 50: {line}"


def endless(pause):
    """One instant, and then none for a long time."""
    yield from instants("5")
    while True:
        pause(1e6)


def test_ctrl_c_closes_the_page_and_lists_what_is_recorded(tmp_path, capsys):
    """Although a thread waits for the next instant; the interrupt goes on."""
    page, pause, out = Page(), Pause(), tmp_path / "out"

    def interrupted(batch):
        subject = predicted(batch)
        if page.seen:
            raise KeyboardInterrupt
        return subject

    def frames():
        yield from instants("5", "6")
        yield from endless(pause)

    with pytest.raises(KeyboardInterrupt):
        show_live(frames(), pause, crop, interrupted, lambda _: page, Recording(out))
    assert (page.seen, page.is_open) == ([5], False)
    report = json.loads((out / "report.json").read_text())
    assert (list(report["files"]), report["instants"]) == (["sequence/0000.ply"], ["5"])
    assert capsys.readouterr().out.startswith("1 shown, 0 dropped")


def test_it_ends_in_time_although_no_instant_comes(capsys):
    pause = Pause()
    frames = endless(pause)
    next(frames)
    show_live(frames, pause, crop, predicted, lambda _: pytest.fail("nothing to show"), seconds=0.01)
    assert capsys.readouterr().out == "0 shown\n"


def test_what_was_shown_is_kept_in_place_of_an_earlier_recording(tmp_path):
    """Other files of earlier runs stay, and files of somebody else are refused before any
    is removed."""
    for names in (("3", "4", "5"), ("6", "7")):
        show_live(instants(*names), Pause(), crop, predicted, lambda _: Page(), Recording(tmp_path))
        written = sorted((tmp_path / "sequence").iterdir())
        assert [path.name for path in written] == [f"{n:04d}.ply" for n in range(len(names))]
        assert [len(read_ply(path)) for path in written] == [int(name) for name in names]
    (tmp_path / "sequence" / "mine.ply").write_text("mine")
    with pytest.raises(InputError, match=r"mine\.ply: expected no file, or one that an earlier"):
        Recording(tmp_path)
    assert written[0].exists()


def test_videos_are_shown_as_they_are_predicted(tmp_path, capsys, monkeypatch):
    """From files to files, to the bit; sizes of masks stay as given."""
    monkeypatch.chdir(tmp_path)
    figure, folder = Figure(3), Path("videos")
    for camera, name in enumerate(figure.names):
        write_video(folder / f"{name}.mp4", numbered_frames(figure, camera, 2))
        write_video(Path("masks") / f"{name}.mp4", mask_frames(figure, camera, 2))
    cameras = figure.write(Path("stills"))
    model = make_model("model=hull").eval()
    write_checkpoint("model.ckpt", model.state_dict(), {**config("model=hull"), "data": {"size": 56}})
    sources = [f"images={folder}", f"cameras={cameras}", "masks=masks", "checkpoint=model.ckpt"]
    assert ghgs("view", "live=true", *sources, "device=cpu", f"port={PORT}", "out=out") == 0
    lines = capsys.readouterr().out.splitlines()
    assert "waiting for an instant in videos" in lines
    assert any(line.startswith("viewer: http://127.0.0.1:") for line in lines)
    assert lines[-1].startswith(("2 shown, 0 dropped, ", "1 shown, 1 dropped"))
    first = next(live_frames(folder, cameras, "masks"))[0]
    expected = predict(first, model, 56, refine_cameras=0, refine_masks=0)
    assert Path("out/sequence/0000.ply").read_bytes() == ply_bytes(expected.gaussians)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((), "images: expected images=<folder of photographs>; found None"),
        (("images=.",), "cameras: expected cameras=<calibration>; found None"),
        (("path=a.ply",), "path: expected null with live=true; found"),
        (("images=nowhere", "cameras=c.json"), "nowhere: expected a folder; found 'no such folder'"),
        (("images=.", "cameras=c.json", "sequence.step=2"), "sequence: expected all instants of a folder"),
    ],
)
def test_what_cannot_be_shown_live_is_one_line(tmp_path, capsys, arguments, message):
    assert ghgs("view", "live=true", *arguments, f"hydra.run.dir={tmp_path}") == 1
    assert f"ghgs view: {message}" in capsys.readouterr().err


def test_cameras_are_shown_live_alone(tmp_path, capsys):
    arguments = ("images={cam0: 0, cam1: 1}", "cameras=c.json", f"hydra.run.dir={tmp_path}")
    assert ghgs("view", *arguments) == 1
    assert "images: expected a folder, or live=true beside cameras; found" in capsys.readouterr().err
    assert ghgs("view", "live=true", *arguments) == 1
    assert "ghgs view: c.json: expected" in capsys.readouterr().err


def test_photographs_need_no_checkpoint(tmp_path, capsys, monkeypatch):
    def refuse(verb):
        raise InputError(f"predicts with {verb.checkpoint}")

    monkeypatch.setattr("ghgs_capture.verbs.predict.run", refuse)
    assert ghgs("view", "images=.", "cameras=c.json", f"hydra.run.dir={tmp_path}") == 1
    assert "predicts with shipped" in capsys.readouterr().err
