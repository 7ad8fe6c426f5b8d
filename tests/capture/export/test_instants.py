"""Files that cover several instants, next to the folder of each."""

import base64
import dataclasses
import json
import re
import zlib

import numpy as np
import pytest
import torch
from imageio_ffmpeg import read_frames

from ghgs_capture.export import Instants, OutputOptions, require_free, write_prediction
from ghgs_lit.errors import InputError
from ghgs_lit.rendering import Renderer, render
from ghgs_lit.types import Batch, Prediction
from ghgs_lit.visualization.turntable import pixel_size
from tests.helpers.splats import body, camera_ring
from tests.helpers.training import Standin

STEP = torch.tensor([0.5, 0.0, 0.1])  # from one instant to the next


def walk(count: int) -> list[tuple[Batch, Prediction]]:
    """Instants of a body that walks steadily out of the first photographs, with a decreasing number of
    Gaussians."""
    cameras, found = camera_ring(3, 60, 60), []
    for number in range(count):
        gaussians = body(1500 - 100 * number, 60)
        rendering = render(gaussians, cameras)
        extrinsics = cameras.extrinsics.clone()
        extrinsics[..., :3, 3] -= (extrinsics[..., :3, :3] @ (number * STEP)[:, None])[..., 0]
        moved = dataclasses.replace(cameras, extrinsics=extrinsics)  # crops follow the subject
        masks = rendering.alpha[:, :, 0] > 0.5
        batch = Batch(
            rendering.image.clamp(0, 1), masks, moved, subjects=(f"{number:03d}",), views=(("a", "b", "c"),)
        )
        gaussians = dataclasses.replace(gaussians, means=gaussians.means + number * STEP)
        found.append((batch, dataclasses.replace(Standin()(batch), gaussians=gaussians)))
    return found


def write(directory, instants, *formats) -> Instants:
    """Write the files of each instant, then those of all."""
    options = OutputOptions(formats, frames=1, fps=4)
    together = Instants(options)
    for batch, prediction in instants:
        folder = directory / batch.subjects[0]
        write_prediction(folder, batch, prediction, Renderer(), options)
        together.add(folder, batch, prediction, Renderer())
    together.write(directory)
    return together


def test_a_page_plays_the_instants(tmp_path):
    """One file for all without a URL, with the cameras of the first instant and the path of the viewer's
    camera."""
    instants = walk(3)
    together = write(tmp_path, instants, "html", "ply")
    text = (tmp_path / "viewer.html").read_text()
    assert not re.search(r"https?://|src=|href=|import ", text)
    parts = dict(re.findall(r'<script type="[^"]+" id="(\w+)">(.*?)</script>', text, re.S))
    scene, lines = json.loads(parts["scene"]), parts["data"].split("\n")
    assert [len(zlib.decompress(base64.b64decode(line))) // 22 for line in lines] == [1500, 1400, 1300]
    assert scene["fps"] == 4
    cameras = instants[0][0].cameras[0]
    assert np.allclose(scene["cameras"][1]["extrinsics"], cameras.extrinsics[1])
    assert scene["pixel"] == pytest.approx(pixel_size(cameras, torch.tensor(scene["target"])))
    assert np.allclose(scene["target"], 0, atol=0.02)
    assert np.allclose(scene["path"], np.arange(3)[:, None] * STEP.numpy(), atol=0.02)
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["instants"] == ["000", "001", "002"]
    assert together.files == ["viewer.html"]
    assert report["files"] == {"viewer.html": (tmp_path / "viewer.html").stat().st_size}


def test_the_video_shows_all_of_a_subject_that_walks_away(tmp_path):
    """The subject is in the centre of every frame, and not cut."""
    write(tmp_path, walk(4), "mp4")
    _, *frames = read_frames(str(tmp_path / "instants.mp4"))
    pictures = [np.frombuffer(frame, np.uint8).reshape(720, 720, 3).max(-1) for frame in frames]
    assert len(pictures) == 4
    for picture in pictures:
        rows, columns = np.nonzero(picture > 60)
        assert np.allclose([rows.mean(), columns.mean()], 360, atol=24)
        assert max(border.max() for border in (picture[0], picture[-1], picture[:, 0], picture[:, -1])) < 30


def test_files_of_another_origin_stay(tmp_path):
    """Outputs replace neither inputs nor foreign files; files of an earlier sequence are replaced."""
    instants = walk(2)
    write(tmp_path, instants, "html")
    write(tmp_path, instants, "ply", "html")
    (tmp_path / "instants.mp4").write_text("somebody's")
    together = Instants(OutputOptions(("html", "mp4"), fps=4))
    with pytest.raises(InputError, match=r"instants\.mp4: expected no file, or one that an earlier"):
        require_free(tmp_path, together.files)
    with pytest.raises(InputError, match=r"viewer\.html: expected another folder .* than that of an input"):
        require_free(tmp_path, together.files, [tmp_path / "viewer.html"])
    require_free(tmp_path, ["viewer.html"])


def test_instants_without_files_of_all_get_none(tmp_path):
    write(tmp_path, walk(2), "inputs")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["000", "001"]


def test_an_empty_instant_does_not_end_the_sequence(tmp_path):
    """For an instant without Gaussians the page shows nothing and the video a black frame."""
    instants = walk(3)
    batch, prediction = instants[1]
    nothing = prediction.gaussians.select(slice(0, 0), (0,))
    instants[1] = (batch, dataclasses.replace(prediction, gaussians=nothing))
    write(tmp_path, instants, "html", "mp4")
    _, *frames = read_frames(str(tmp_path / "instants.mp4"))
    brightest = [np.frombuffer(frame, np.uint8).max() for frame in frames]
    assert brightest[1] < 20 < 100 < min(brightest[0], brightest[2])
