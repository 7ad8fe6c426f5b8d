"""Gaussians in each format, read by programs that are not ours, and rendered again."""

import base64
import gzip
import io
import json
import re
import subprocess
import weakref
from types import SimpleNamespace

import numpy as np
import pygltflib
import pytest
import torch
import trimesh
from gaussforge import GaussForge
from imageio_ffmpeg import get_ffmpeg_exe, read_frames
from PIL import Image
from scipy.spatial.transform import Rotation

from ghgs_capture.export.compact import CONVERTED, converted, half_turned, to_records
from ghgs_capture.export.gltf import EXTENSION, glb_bytes
from ghgs_capture.export.instants import mp4_bytes
from ghgs_capture.export.maps import input_files
from ghgs_capture.export.page import page, unpack
from ghgs_lit.errors import InputError
from ghgs_lit.metrics import psnr
from ghgs_lit.ply import SH_CONSTANT, ply_bytes, read_ply
from ghgs_lit.rendering import render
from ghgs_lit.types import Gaussians
from ghgs_lit.visualization.turntable import pixel_size
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


def covariances(gaussians: Gaussians) -> np.ndarray:
    """By scipy, [N, 3, 3]."""
    rotations = Rotation.from_quat(gaussians.quaternions.numpy(), scalar_first=True).as_matrix()
    axes = rotations * gaussians.scales.numpy()[:, None]
    return axes @ axes.swapaxes(-1, -2)


# What is lost is quantization; a wrong axis, order or unit is below 25 dB.
@pytest.mark.parametrize(("name", "least"), [("compressed_ply", 45), ("spz", 45), ("sog", 55)])
def test_compact_files_render_alike(gaussians, name, least, tmp_path):
    ply = ply_bytes(gaussians)
    content = converted(name, gaussians)
    assert len(content) < len(ply) / 2
    read = read_back(content, CONVERTED[name], tmp_path / "a.ply")
    if name == "spz":  # gaussforge leaves the axes of the file as they are
        read = half_turned(read)
    assert decibels(read, gaussians) > least


def test_spz_has_y_up_and_z_back_as_its_specification_says(gaussians):
    """Places of the file itself: 24 bits each, after a header of 16 bytes (nianticlabs/spz), are the
    PLY's with y and z negated; splat-transform, the reader of SuperSplat, negates them again."""
    content = gzip.decompress(converted("spz", gaussians))
    count, bits = int.from_bytes(content[8:12], "little"), content[13]
    numbers = np.frombuffer(content[16 : 16 + 9 * count], np.uint8).reshape(count, 3, 3).astype(np.int32)
    stored = ((numbers << [8, 16, 24]).sum(-1, dtype=np.int32) >> 8) / 2**bits
    assert np.abs(stored - gaussians.means.numpy() * [1, -1, -1]).max() < 2 / 2**bits
    spread, turned = (covariances(g) for g in (gaussians, half_turned(gaussians)))
    flip = np.diag([1, -1, -1])
    assert np.allclose(turned, flip @ spread @ flip, rtol=1e-4, atol=1e-6 * spread.max())


def test_a_splat_file_renders_alike_and_begins_with_large_gaussians(gaussians, tmp_path):
    records = to_records(gaussians)
    assert records.nbytes == 32 * len(gaussians)
    read = read_back(records.tobytes(), "splat", tmp_path / "a.ply")
    assert decibels(read, gaussians) > 50
    found, wanted = (
        torch.nn.functional.normalize(g.quaternions[g.means[:, 0].argsort()], dim=-1)
        for g in (read, gaussians)
    )
    assert (found * wanted).sum(-1).abs().min() > 0.9998  # two degrees
    size = records["scale"].astype(np.float64).prod(-1) * records["color"][:, 3]
    assert size[:500].mean() > 2 * size[-500:].mean()


def test_a_glb_has_the_khronos_extension_and_stands_upright(gaussians, tmp_path):
    """Linear scales, opacities, xyzw, SH; lossless; the node turns the world's up to glTF's +y."""
    (tmp_path / "a.glb").write_bytes(glb_bytes(gaussians, UP))
    model = pygltflib.GLTF2().load(tmp_path / "a.glb")
    primitive, blob = model.meshes[0].primitives[0], model.binary_blob()
    assert model.extensionsUsed == [EXTENSION]
    assert primitive.mode == pygltflib.POINTS
    assert primitive.extensions[EXTENSION]["kernel"] == "ellipse"

    def column(name: str) -> torch.Tensor:
        accessor = model.accessors[vars(primitive.attributes)[name]]
        view = model.bufferViews[accessor.bufferView]
        assert view.byteOffset % 4 == 0
        data = blob[view.byteOffset : view.byteOffset + view.byteLength]
        return torch.from_numpy(np.frombuffer(data, "<f4").reshape(accessor.count, -1).copy())

    read = Gaussians(
        means=column("POSITION"),
        quaternions=column(f"{EXTENSION}:ROTATION")[:, [3, 0, 1, 2]],
        scales=column(f"{EXTENSION}:SCALE"),
        opacities=column(f"{EXTENSION}:OPACITY")[:, 0],
        colors=column(f"{EXTENSION}:SH_DEGREE_0_COEF_0") * SH_CONSTANT + 0.5,
        splits=gaussians.splits,
    )
    assert decibels(read, gaussians) > 80
    turned = Rotation.from_quat(model.nodes[0].rotation).apply(UP.numpy())
    assert np.allclose(turned, [0, 1, 0], atol=1e-6)
    # as points, for programs without the extension
    cloud = trimesh.load(tmp_path / "a.glb").to_geometry()
    upright = gaussians.means.numpy() * [1, -1, -1]
    assert np.allclose(np.sort(cloud.vertices[:, 1]), np.sort(upright[:, 1]), atol=1e-5)
    colors = (gaussians.colors.clamp(0, 1) * 255).round().numpy()
    assert np.array_equal(cloud.colors[:, :3], colors)
    with pytest.raises(InputError, match="at least one Gaussian; found 0"):
        glb_bytes(gaussians.select(slice(0, 0), (0,)), UP)


def test_a_ply_is_lossless(gaussians, tmp_path):
    assert decibels(read_back(ply_bytes(gaussians), "ply", tmp_path / "a.ply"), gaussians) > 80


def test_a_page_holds_the_scene_and_needs_no_network(gaussians, tmp_path):
    """One file: no address, the Gaussians, the cameras; names cannot end the script."""
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
    """A picture is made when the one before is written."""
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
