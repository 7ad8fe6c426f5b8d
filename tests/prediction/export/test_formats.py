"""Gaussians in each format, read by programs that are not ours, and rendered again."""

import base64
import io
import json
import re
import subprocess
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from gaussforge import GaussForge
from imageio_ffmpeg import get_ffmpeg_exe, read_frames
from PIL import Image

from ghgs_lit.metrics import psnr
from ghgs_lit.prediction.export.maps import input_files, mp4_bytes
from ghgs_lit.prediction.export.page import page
from ghgs_lit.prediction.export.ply import ply_bytes, read_ply
from ghgs_lit.rendering import render
from ghgs_lit.types import Gaussians
from ghgs_lit.visualization.turntable import pixel_size
from tests.helpers.packed import unpack
from tests.helpers.splats import body, camera_ring

UP = torch.tensor([0.0, -1.0, 0.0])


@pytest.fixture(scope="module")
def gaussians():
    return body(2000, 120)


def decibels(found: Gaussians, wanted: Gaussians) -> float:
    """The least PSNR of two views."""
    cameras = camera_ring(2, 100, 80)
    images = [render(g, cameras, backend="cpu").image.flatten(0, 1) for g in (found, wanted)]
    assert images[1].max() > 0.5
    return float(psnr(*images).min())


def read_back(data: bytes, name: str, path) -> Gaussians:
    """The content of a file as gaussforge reads it."""
    path.write_bytes(GaussForge().convert(data, name, "ply")["data"])
    return read_ply(path)


def test_a_ply_is_lossless(gaussians, tmp_path):
    assert decibels(read_back(ply_bytes(gaussians), "ply", tmp_path / "a.ply"), gaussians) > 80


def test_a_page_holds_the_scene_and_needs_no_network(gaussians, tmp_path):
    """One file: no address, the Gaussians, the cameras; names cannot end the script."""
    cameras = camera_ring(2, 100, 80)[0]
    name, wicked = "</title><script>{{data}}", "</script><!--<script>"  # the last two open a second script
    subject = SimpleNamespace(gaussians=gaussians, cameras=cameras, views=("a", wicked), up=UP)
    subject.center = torch.tensor([0.0, 0.1, 0.2])
    subject.pixel = pixel_size(cameras, subject.center)
    text = page(subject, name)
    assert not re.search(r"https?://|src=|href=|import ", text)
    assert text.count("<script") == text.count("</script>") == 3
    assert "<!--" not in text
    parts = dict(re.findall(r'<script type="[^"]+" id="(\w+)">(.*?)</script>', text, re.S))
    scene = json.loads(parts["scene"])
    assert [camera["name"] for camera in scene["cameras"]] == ["a", wicked]
    assert np.allclose(scene["cameras"][1]["extrinsics"], cameras.extrinsics[1])
    assert scene["size"] == [80, 100]
    assert np.allclose(scene["target"], [0, 0.1, 0.2])
    data = base64.b64decode(parts["data"])
    found = unpack(data, scene["pixel"], torch.tensor(scene["target"]), scene["steps"], gaussians)
    assert decibels(found, gaussians) > 50


def test_a_video_shows_the_pictures_in_their_colors(tmp_path):
    """Odd sides are padded; saturated colours come back, and the file says by which matrix."""
    bars = np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255], [255, 255, 0], [0, 255, 255], [255, 0, 255]])
    row = np.repeat(bars, 10, axis=0)
    pictures = [
        np.tile(np.concatenate([row, row[-1:]]) * (5 - frame) // 5, (45, 1, 1)).astype(np.uint8)
        for frame in range(5)
    ]
    (tmp_path / "a.mp4").write_bytes(mp4_bytes(pictures, 10))
    frames = read_frames(str(tmp_path / "a.mp4"))
    meta = next(frames)
    assert meta["source_size"] == (62, 46)
    assert meta["fps"] == pytest.approx(10)
    assert meta["codec"] == "h264"
    info = subprocess.run([get_ffmpeg_exe(), "-i", tmp_path / "a.mp4"], capture_output=True, text=True)
    assert "yuv420p(tv, bt709" in info.stderr
    read = [np.frombuffer(frame, np.uint8).reshape(46, 62, 3)[:45, :61].astype(int) for frame in frames]
    assert len(read) == 5
    middle = np.arange(61) % 10 // 3 == 1  # 4:2:0 mixes colours at their borders
    for found, wanted in zip(read, pictures, strict=True):
        assert np.abs(found - wanted)[:, middle].mean() < 4


def test_cameras_say_the_height_and_width_of_their_photographs():
    """Of photographs that are not square, beside PNGs of that size."""
    cameras = camera_ring(2, 30, 20)[0]
    images, mattes = torch.rand(2, 3, 30, 20), torch.ones(2, 30, 20)
    names = ("front", "back")
    subject = SimpleNamespace(images=images, mattes=mattes, cameras=cameras, file_names=names)
    *pictures, text = (make() for make in input_files(subject))
    assert [Image.open(io.BytesIO(picture)).size for picture in pictures] == [(20, 30)] * 2
    stored = json.loads(text)["cameras"]
    assert {name: (camera["width"], camera["height"]) for name, camera in stored.items()} == dict.fromkeys(
        names, (20, 30)
    )
    np.testing.assert_allclose(stored["back"]["intrinsics"], cameras.intrinsics[1], rtol=1e-6)
