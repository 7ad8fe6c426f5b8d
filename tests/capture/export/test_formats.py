"""Gaussians in each format are read by other programs and rendered again."""

import base64
import dataclasses
import gzip
import io
import json
import math
import re
import shutil
import subprocess
import weakref
import zlib
from importlib.resources import files
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from gaussforge import GaussForge
from imageio_ffmpeg import get_ffmpeg_exe, read_frames
from PIL import Image
from scipy.spatial.transform import Rotation
from torch.nn.functional import normalize

from ghgs_capture.export.instants import mp4_bytes
from ghgs_capture.export.page import COARSE, FINE, pack, page
from ghgs_capture.export.prediction import CONVERTED, convert, half_turn, input_files
from ghgs_lit.metrics import psnr
from ghgs_lit.ply import ply_bytes, read_ply
from ghgs_lit.rendering import render
from ghgs_lit.types import Gaussians
from ghgs_lit.visualization.turntable import pixel_size
from tests.helpers.splats import body, camera_ring, unpack

UP = torch.tensor([0.0, -1.0, 0.0])


@pytest.fixture(scope="module")
def gaussians():
    return body(2000, 120)


def decibels(found: Gaussians, wanted: Gaussians) -> float:
    """Lower PSNR of two views."""
    cameras = camera_ring(2, 100, 80)
    images = [render(g, cameras, backend="cpu").image.flatten(0, 1) for g in (found, wanted)]
    assert images[1].max() > 0.5
    return float(psnr(*images).min())


def read_back(data: bytes, name: str, path) -> Gaussians:
    """Content of a file as read by gaussforge."""
    path.write_bytes(GaussForge().convert(data, name, "ply")["data"])
    return read_ply(path)


def covariances(gaussians: Gaussians) -> np.ndarray:
    """Covariances [N, 3, 3], by SciPy."""
    rotations = Rotation.from_quat(gaussians.quaternions.numpy(), scalar_first=True).as_matrix()
    axes = rotations * gaussians.scales.numpy()[:, None]
    return axes @ axes.swapaxes(-1, -2)


# What is lost is quantization; a wrong axis, order or unit is below 25 dB.
@pytest.mark.parametrize(("name", "least"), [("compressed_ply", 45), ("spz", 45), ("sog", 55)])
def test_compact_files_render_alike(gaussians, name, least, tmp_path):
    ply = ply_bytes(gaussians)
    content = convert(name, gaussians)
    assert len(content) < len(ply) / 2
    read = read_back(content, CONVERTED[name], tmp_path / "a.ply")
    if name == "spz":  # gaussforge leaves the axes of the file as they are
        read = half_turn(read)
    assert decibels(read, gaussians) > least


def test_spz_has_y_up_and_z_back_as_its_specification_says(gaussians):
    """Positions in the file (24 bits each, after a header of 16 bytes; nianticlabs/spz) are the PLY's with y
    and z negated; splat-transform, the reader of SuperSplat, negates them again."""
    content = gzip.decompress(convert("spz", gaussians))
    count, bits = int.from_bytes(content[8:12], "little"), content[13]
    numbers = np.frombuffer(content[16 : 16 + 9 * count], np.uint8).reshape(count, 3, 3).astype(np.int32)
    stored = ((numbers << [8, 16, 24]).sum(-1, dtype=np.int32) >> 8) / 2**bits
    assert np.abs(stored - gaussians.means.numpy() * [1, -1, -1]).max() < 2 / 2**bits
    spread, turned = (covariances(g) for g in (gaussians, half_turn(gaussians)))
    flip = np.diag([1, -1, -1])
    assert np.allclose(turned, flip @ spread @ flip, rtol=1e-4, atol=1e-6 * spread.max())


def test_a_page_holds_the_scene_and_needs_no_network(gaussians, tmp_path):
    """A page is one file with Gaussians and cameras and no URL; names cannot end the script."""
    cameras = camera_ring(2, 100, 80)[0]
    # the last two open a second script
    name, wicked = "</title><script>{{data}}", "</script><!--<script>"
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


def test_a_long_video_is_not_in_memory_as_a_whole():
    """Each frame is rendered after the previous one is written."""
    made, alive = [], []

    def pictures():
        for number in range(20):
            picture = np.full((16, 16, 3), 10 * number, np.uint8)
            made.append(weakref.ref(picture))
            yield picture
            del picture
            alive.append(sum(ref() is not None for ref in made))

    assert mp4_bytes(pictures(), 10)
    assert len(alive) == 20
    assert max(alive) <= 2


def test_a_video_shows_the_pictures_in_their_colors(tmp_path):
    """Odd sides are padded; saturated colours are preserved, and the file states its colour matrix."""
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
    """Also for photographs that are not square; the PNGs have the same size."""
    cameras = camera_ring(2, 30, 20)[0]
    images, mattes = torch.rand(2, 3, 30, 20), torch.ones(2, 30, 20)
    names = ("front", "back")
    subject = SimpleNamespace(images=images, mattes=mattes, cameras=cameras, views=names)
    *pictures, text = (make() for make in input_files(subject))
    assert [Image.open(io.BytesIO(picture)).size for picture in pictures] == [(20, 30)] * 2
    stored = json.loads(text)["cameras"]
    assert {name: (camera["width"], camera["height"]) for name, camera in stored.items()} == dict.fromkeys(
        names, (20, 30)
    )
    np.testing.assert_allclose(stored["back"]["intrinsics"], cameras.intrinsics[1], rtol=1e-6)


PIXEL, CENTER = 0.01, torch.tensor([0.1, -0.2, 30.0])


@pytest.fixture
def varied() -> Gaussians:
    """Gaussians of varied shapes, colours and directions, including the values 0 and 1."""
    found = body(3000, 120)
    found.colors[:100], found.colors[100:200], found.opacities[50:150] = 0.0, 1.0, 1.0
    return dataclasses.replace(found, means=found.means + CENTER, low_pass=0.1, antialiased=True)


def packed_and_back(gaussians: Gaussians, steps=COARSE) -> Gaussians:
    return unpack(pack(gaussians, PIXEL, CENTER, steps), PIXEL, CENTER, steps, gaussians)


@pytest.mark.parametrize(("steps", "degrees"), [(FINE, 1.6), (COARSE, 6.5)])
def test_gaussians_come_back_within_half_a_step_in_their_order(varied, steps, degrees):
    found = packed_and_back(varied, steps)
    assert (found.splits, found.low_pass, found.antialiased) == ((3000,), 0.1, True)
    far = 2e-6  # what float32 rounds at 30 m
    assert (found.means - varied.means).abs().max() <= 0.5 * PIXEL / steps["center"] + far
    assert (found.scales / varied.scales).log().abs().max() <= 0.501 / steps["scale"]
    assert (found.opacities - varied.opacities).abs().max() <= 0.501 / steps["opacity"]
    assert (found.colors - varied.colors).abs().max() <= 0.501 / 255
    cosines = (normalize(found.quaternions) * normalize(varied.quaternions)).sum(-1).abs()
    # half a step of all three numbers, four times
    assert cosines.min() > math.cos(math.radians(degrees) / 2)


def test_floaters_and_scales_of_nothing_stay_finite(varied):
    """Extreme values are clamped to the nearest ones and do not affect the precision of others."""
    changed = dataclasses.replace(varied, means=varied.means.clone(), scales=varied.scales.clone())
    changed.means[0], changed.scales[1], changed.scales[2] = 1e9, 0.0, 1e9
    found, before = packed_and_back(changed), packed_and_back(varied)
    assert all(getattr(found, name).isfinite().all() for name in ("means", "scales", "quaternions"))
    assert (found.means[0] > 1e5).all()
    assert (found.scales[1] < PIXEL / 1000).all()
    assert (found.scales[2] > 1000 * PIXEL).all()
    assert torch.equal(found.means[1:], before.means[1:])
    assert torch.equal(found.scales[3:], before.scales[3:])
    assert len(packed_and_back(varied.select(slice(0, 0), (0,)))) == 0


@pytest.mark.skipif(shutil.which("node") is None, reason="needs node")
def test_the_page_unpacks_the_same(varied, tmp_path):
    """The page's own functions, run outside of a browser: the shader's table equals our reader's values."""
    text = files("ghgs_capture.export").joinpath("page.html").read_text()
    function = re.search(r"function table\(.*?\n}\n", text, re.S)[0]
    packed = pack(varied, PIXEL, CENTER, FINE)
    scene = {"steps": FINE, "pixel": PIXEL, "target": CENTER.tolist()}
    planes = list(zlib.decompress(packed))
    script = f"const scene = {json.dumps(scene)}; {function}\nconst found = table(new Uint8Array({planes}));"
    (tmp_path / "a.js").write_text(script + "process.stdout.write(new Uint8Array(found.buffer));")
    done = subprocess.run(["node", tmp_path / "a.js"], capture_output=True, check=True)
    values = np.frombuffer(done.stdout, "<f4").reshape(-1, 12)
    assert len(values) == 3 * 1024
    assert not values[3000:].any()
    values, wanted = values[:3000], unpack(packed, PIXEL, CENTER, FINE, varied)
    assert np.allclose(values[:, :3], wanted.means, atol=1e-6)
    assert np.allclose(values[:, 4:7], wanted.scales)
    assert np.allclose(values[:, 7], wanted.opacities)
    assert np.allclose(values[:, 8:], wanted.quaternions, atol=1e-6)
    colors = np.ascontiguousarray(values[:, 3]).view(np.uint8).reshape(-1, 4)[:, :3]
    assert np.array_equal(colors, (wanted.colors * 255).round())
