"""The rendered layout: what is written is read back, others' variants too, and bad files are named."""

import os
import shutil

import numpy as np
import pytest
import torch
from PIL import Image

from ghgs_lit.data.layout import Layout, View, encode_depth, write_body, write_view
from ghgs_lit.data.sampling import subject_rng
from ghgs_lit.errors import InputError
from ghgs_lit.geometry.projection import unproject_maps
from ghgs_lit.synthesis.photograph import Studio
from ghgs_lit.synthesis.scans import ScanSource, split_names
from ghgs_lit.types import Cameras
from tests.helpers.people import RIG, TINY, box_person, render_boxes, write_obj_scan

SIZE = 56


def write_person(root, name="box", size=SIZE, pids=(0, 4)) -> dict:
    """Photographs of a box, written below ``root/train``; what went in, by position."""
    person = RIG.place(box_person(name), subject_rng(0, name))
    studio = Studio(person, TINY.lights.draw(subject_rng(1, name)))
    written = {}
    for pid in pids:
        cameras = RIG.cameras(np.array([22.5 * pid]), size, size)
        photographs = studio.shoot(cameras)
        image = np.round(photographs.images[0] * 255).astype(np.uint8)
        inverse = encode_depth(photographs.depths[0])
        view = View(
            image, photographs.masks[0], inverse, cameras.intrinsics[0].numpy(), cameras.extrinsics[0].numpy()
        )
        write_view(root / "train", f"{name}_{pid:03d}", 0, view)
        written[pid] = (photographs, cameras)
    write_body(root / "train", name, person.body_vertices)
    return written


@pytest.fixture
def root(tmp_path):
    write_person(tmp_path)
    return tmp_path


def on_box(view: View, person) -> np.ndarray:
    """Distance of unprojected depth to the surface of the box."""
    height, width = view.mask.shape
    cameras = Cameras(torch.from_numpy(view.intrinsics), torch.from_numpy(view.extrinsics), height, width)
    points = unproject_maps(torch.from_numpy(view.depth), cameras).numpy()[view.mask & (view.depth > 0)]
    low, high = person.parts[0].vertices.min(0), person.parts[0].vertices.max(0)
    outside = np.maximum(np.maximum(low - points, points - high), 0)
    inside = np.minimum(points - low, high - points).min(-1)
    return np.linalg.norm(outside, axis=-1) + np.maximum(inside, 0)


def test_round_trip(tmp_path):
    written = write_person(tmp_path)
    layout = Layout(tmp_path, "train")
    assert layout.subjects == {"box": (0, 4)}
    person = RIG.place(box_person(), subject_rng(0, "box"))
    np.testing.assert_array_equal(layout.body("box"), person.body_vertices)
    for pid, (photographs, cameras) in written.items():
        view = layout.view("box", pid, 0)
        assert np.abs(view.image / 255 - photographs.images[0]).max() < 0.06
        np.testing.assert_array_equal(view.mask, photographs.masks[0])
        np.testing.assert_allclose(view.depth, photographs.depths[0], atol=1.5e-4)
        np.testing.assert_allclose(view.intrinsics, cameras.intrinsics[0], rtol=1e-6)
        np.testing.assert_allclose(view.extrinsics, cameras.extrinsics[0], atol=1e-6)
        assert np.quantile(on_box(view, person), 0.95) < 1e-3


def test_depth_code_is_inverse_and_keeps_zero():
    depth = np.array([0.0, 0.25, 1.0, 2.0, 3.0], np.float32)
    code = encode_depth(depth)
    assert code.tolist() == [0, 65535, 32768, 16384, 10923]


@pytest.mark.parametrize("size", [(28, 28), (28, 42), (112, 84), (30, 21)])
def test_resized_views_keep_their_geometry(root, size):
    """Unprojected depth of a resized view still lies on the mesh: intrinsics follow pixels exactly."""
    view = Layout(root, "train", size).view("box", 0, 0)
    assert view.image.shape == (*size, 3)
    assert view.mask.shape == view.depth.shape == size
    person = RIG.place(box_person(), subject_rng(0, "box"))
    # Nearest depth is off by at most half a source pixel, 2 cm, along a surface.
    assert np.quantile(on_box(view, person), 0.9) < 0.015
    scale = np.array([size[1] / SIZE, size[0] / SIZE, 1])
    original = Layout(root, "train").view("box", 0, 0)
    np.testing.assert_allclose(view.intrinsics, original.intrinsics * scale[:, None], rtol=1e-6)
    # A larger camera of the same rig is the same camera.
    camera = RIG.cameras(np.zeros(1), SIZE, SIZE).resized(*size)
    np.testing.assert_allclose(view.intrinsics, camera.intrinsics[0], rtol=1e-5)


def test_halving_averages_areas(root):
    full, half = Layout(root, "train").view("box", 0, 0), Layout(root, "train", (28, 28)).view("box", 0, 0)
    mean = full.image.reshape(28, 2, 28, 2, 3).mean((1, 3))
    assert np.abs(half.image - mean).max() <= 1  # two passes, each rounded


def test_renders_of_others_are_read(root):
    """PNG photographs, masks of three channels with 0/1, no depth, smplx only, 4 x 4 poses, hr images."""
    ours = Layout(root, "train", pixel_centers="half").view("box", 0, 0)
    img, mask, depth, parm = (root / "train" / k / "box_000" for k in ("img", "mask", "depth", "parm"))
    Image.open(img / "0.jpg").save(img / "0.png")
    shutil.copy(img / "0.jpg", img / "2_hr.jpg")
    (img / "0.jpg").unlink()
    binary = (np.asarray(Image.open(mask / "0.png")) > 0).astype(np.uint8)
    Image.fromarray(np.stack([binary, 0 * binary, 0 * binary], -1)).save(mask / "0.png")
    shutil.rmtree(depth)
    extrinsic = np.load(parm / "0_extrinsic.npy")
    np.save(parm / "0_extrinsic.npy", np.concatenate((extrinsic, [[0, 0, 0, 1]])))
    os.rename(root / "train" / "smpl", root / "train" / "smplx")
    layout = Layout(root, "train", pixel_centers="integer")
    view = layout.view("box", 0, 0)
    np.testing.assert_array_equal(view.image, ours.image)
    np.testing.assert_array_equal(view.mask, ours.mask)
    np.testing.assert_array_equal(view.extrinsics, ours.extrinsics)
    assert view.depth is None
    assert layout.vids("box", 0) == [0]
    assert len(layout.body("box")) == 8
    assert Layout(root, "train", body_models=["smpl"]).body("box") is None
    np.testing.assert_allclose(view.intrinsics[:2, 2], ours.intrinsics[:2, 2] + 0.5, rtol=1e-6)
    half = Layout(root, "train", (28, 28), pixel_centers="integer").view("box", 0, 0)
    np.testing.assert_allclose(half.intrinsics[:2, 2], (ours.intrinsics[:2, 2] + 0.5) / 2, rtol=1e-6)


def test_cache_keeps_what_fits_and_no_more(root):
    layout = Layout(root, "train", cache_mb=2 * (SIZE * SIZE * 6 + 1024) / 2**20)
    first = layout.view("box", 0, 0)
    assert layout.view("box", 0, 0) is first
    layout.view("box", 4, 0)
    layout.body("box")  # the third thing: the oldest goes
    assert layout.view("box", 0, 0) is not first
    assert layout._cached <= layout._limit
    nothing = Layout(root, "train")
    assert nothing.view("box", 0, 0) is not nothing.view("box", 0, 0)


def damage(root, kind: str) -> str:
    """Make one file bad; a pattern that the error must match."""
    img, mask, depth, parm = (root / "train" / k / "box_000" for k in ("img", "mask", "depth", "parm"))
    focal = np.load(parm / "0_intrinsic.npy")
    pose = np.load(parm / "0_extrinsic.npy")
    if kind == "image missing":
        (img / "0.jpg").unlink()
        return r"box_000/0\.jpg: expected an image; found no such file"
    if kind == "image truncated":
        (img / "0.jpg").write_bytes((img / "0.jpg").read_bytes()[:200])
        return r"box_000/0\.jpg: expected a readable image; found"
    if kind == "image is text":
        (img / "0.jpg").write_text("no image")
        return r"box_000/0\.jpg: expected a readable image; found"
    if kind == "mask missing":
        (mask / "0.png").unlink()
        return r"mask/box_000/0\.png: expected an image; found no such file"
    if kind == "mask size":
        Image.new("L", (20, 30)).save(mask / "0.png")
        return r"mask/box_000/0\.png: expected the size of its photograph, 56x56; found 30x20"
    if kind == "depth of 8 bits":
        Image.new("L", (SIZE, SIZE)).save(depth / "0.png")
        return r"depth/box_000/0\.png: expected 16 bits of inverse depth; found 8"
    if kind == "zero focal":
        focal[0, 0] = 0
        np.save(parm / "0_intrinsic.npy", focal)
        return r"0_intrinsic\.npy: expected focal lengths above 0; found 0\.0"
    if kind == "nan camera":
        pose[1, 3] = np.nan
        np.save(parm / "0_extrinsic.npy", pose)
        return r"0_extrinsic\.npy: expected finite numbers; found NaN"
    if kind == "camera shape":
        np.save(parm / "0_extrinsic.npy", pose[:2])
        return r"0_extrinsic\.npy: expected an array 3x4 or 4x4; found 2x4"
    if kind == "no rotation":
        pose[:, :3] *= 2
        np.save(parm / "0_extrinsic.npy", pose)
        return r"0_extrinsic\.npy: expected a rotation in the first three columns; found"
    if kind == "camera garbage":
        (parm / "0_intrinsic.npy").write_bytes(b"\x93NUMPY garbage")
        return r"0_intrinsic\.npy: expected an array 3x3; found a file that cannot be read"
    (parm / "0_intrinsic.npy").unlink()
    return r"0_intrinsic\.npy: expected an array 3x3; found no such file"


BAD_IMAGES = [
    "image missing",
    "image truncated",
    "image is text",
    "mask missing",
    "mask size",
    "depth of 8 bits",
]
BAD_CAMERAS = ["zero focal", "nan camera", "camera shape", "no rotation", "camera garbage", "camera missing"]


@pytest.mark.parametrize("kind", BAD_IMAGES + BAD_CAMERAS)
def test_bad_files_are_named(root, kind):
    pattern = damage(root, kind)
    with pytest.raises(InputError, match=pattern) as caught:
        Layout(root, "train").view("box", 0, 0)
    assert "\n" not in str(caught.value)


def test_missing_roots_and_phases(tmp_path):
    with pytest.raises(
        InputError, match=r"nowhere: expected the root of a rendered data set; found no such folder"
    ):
        Layout(tmp_path / "nowhere", "train")
    with pytest.raises(InputError, match=r"train/img: expected a folder <id>_<position>"):
        Layout(tmp_path, "train")
    (tmp_path / "train" / "img" / "unrelated").mkdir(parents=True)
    with pytest.raises(InputError, match=r"expected folders <id>_<position>; found none"):
        Layout(tmp_path, "train")
    with pytest.raises(InputError, match=r"found 0 \(x is missing"):
        Layout(tmp_path, "train", names=["x"])


def test_obj_scans_are_loaded_as_they_are(tmp_path):
    write_obj_scan(tmp_path, "a", (200, 90, 30))
    person = ScanSource(tmp_path).load("a")
    part = person.parts[0]
    np.testing.assert_allclose(part.vertices.min(0), [1 - 0.205, 1.25, 2.85], atol=1e-5)
    assert np.abs(part.texture.reshape(-1, 3).mean(0) - [200, 90, 30]).max() < 3
    assert person.body_vertices.dtype == np.float32
    assert len(person.body_vertices) == 8
    (tmp_path / "a" / "material0.mtl").unlink()  # often lost: the picture beside the mesh is found anyway
    assert ScanSource(tmp_path).load("a").parts[0].texture.shape == (4, 4, 3)


def test_glb_scans_keep_parts_frames_and_cutouts(tmp_path):
    import trimesh
    from trimesh.visual import TextureVisuals
    from trimesh.visual.material import PBRMaterial

    scene = trimesh.Scene()
    for k, (mode, cutoff) in enumerate([("OPAQUE", None), ("MASK", 0.3), ("BLEND", None)]):
        mesh = trimesh.creation.box((0.1, 0.2, 0.3))
        texture = Image.fromarray(np.full((4, 4, 4), 50 * k, np.uint8))
        material = PBRMaterial(baseColorTexture=texture, alphaMode=mode, alphaCutoff=cutoff)
        mesh.visual = TextureVisuals(uv=np.zeros((len(mesh.vertices), 2)), material=material)
        scene.add_geometry(
            mesh, node_name=f"n{k}", transform=trimesh.transformations.translation_matrix([0, k, 0])
        )
    (tmp_path / "g").mkdir()
    scene.export(tmp_path / "g" / "g.glb")
    parts = ScanSource(tmp_path).load("g").parts
    assert [part.alpha_cutoff for part in parts] == [None, pytest.approx(0.3), 0.5]
    assert [part.texture.shape[2] for part in parts] == [3, 4, 4]
    np.testing.assert_allclose([part.vertices[:, 1].mean() for part in parts], [0, 1, 2], atol=1e-6)
    plain = trimesh.Scene([trimesh.creation.box()])
    plain.export(tmp_path / "g" / "g.glb")
    with pytest.raises(InputError, match=r"g\.glb: expected a texture for the mesh"):
        ScanSource(tmp_path).load("g")


def test_bad_scans_are_named(tmp_path):
    with pytest.raises(InputError, match="nowhere: expected a folder of scans; found no such folder"):
        ScanSource(tmp_path / "nowhere").names()
    with pytest.raises(InputError, match=r"expected <id>/<id>\.obj or <id>/<id>\.glb; found none"):
        ScanSource(tmp_path).names()
    path = write_obj_scan(tmp_path, "bare", textured=False)
    with pytest.raises(InputError, match=r"bare\.obj: expected a texture for the mesh .*; found none"):
        ScanSource(tmp_path).load("bare")
    path.write_text("f 1 2 3\n")
    with pytest.raises(InputError, match=r"bare\.obj: expected"):
        ScanSource(tmp_path).load("bare")
    with pytest.raises(InputError, match=r"other: expected other\.obj or other\.glb; found neither"):
        ScanSource(tmp_path).load("other")
    write_obj_scan(tmp_path, "body")
    np.save(tmp_path / "body" / "body_vertices.npy", np.zeros((5, 2)))
    with pytest.raises(InputError, match=r"body_vertices\.npy: expected an array nx3; found 5x2"):
        ScanSource(tmp_path).load("body")


def test_splits(tmp_path):
    names = [f"s{i}" for i in range(10)]
    drawn = split_names(tmp_path, names, None, 0.2, 0)
    assert sorted(drawn["train"] + drawn["val"]) == names
    assert len(drawn["val"]) == 2
    assert drawn == split_names(tmp_path, names, None, 0.2, 0)
    assert drawn != split_names(tmp_path, names, None, 0.2, 1)
    (tmp_path / "split_train.txt").write_text("s1\ns2\n")
    with pytest.raises(InputError, match=r"split_val\.txt: expected one id a line; found no such file"):
        split_names(tmp_path, names, str(tmp_path), 0.2, 0)
    (tmp_path / "split_val.txt").write_text("s3\n")
    assert split_names(tmp_path, names, None, 0.2, 0) == {"train": ["s1", "s2"], "val": ["s3"]}
    custom = tmp_path / "mine.json"
    custom.write_text('{"train": ["s4"], "test": ["s5"], "note": "x"}')
    assert split_names(tmp_path, names, str(custom), 0.2, 0) == {"train": ["s4"], "val": ["s5"]}
    for content, pattern in [
        ('{"train": ["s4"], "val": ["zz"]}', "expected ids of scans in .*; found 'zz' in val"),
        ('{"train": ["s4"], "val": ["s4"]}', "expected disjoint train and val; found 's4' in both"),
        ('{"train": ["s4"]}', "expected a list 'val'"),
        ("[1", "expected JSON; found"),
    ]:
        custom.write_text(content)
        with pytest.raises(InputError, match=pattern):
            split_names(tmp_path, names, str(custom), 0.2, 0)
    with pytest.raises(InputError, match="expected a JSON file or a folder"):
        split_names(tmp_path, names, str(tmp_path / "none.json"), 0.2, 0)


def test_rendered_scans_share_one_transform(tmp_path):
    """Depth and body vertices of a rendered scan meet: the body here is the box itself."""
    render_boxes(tmp_path / "out", tmp_path / "scans", train=1, val=0)
    layout = Layout(tmp_path / "out", "train")
    body = layout.body("s0")
    assert body[:, 1].min() == pytest.approx(0, abs=2e-3)  # stored in 16 bits beside the mesh
    assert 1.75 <= np.ptp(body[:, 1]) <= 1.85
    for pid in layout.subjects["s0"][::5]:
        for vid in layout.vids("s0", pid):
            view = layout.view("s0", pid, vid)
            height, width = view.mask.shape
            cameras = Cameras(
                torch.from_numpy(view.intrinsics), torch.from_numpy(view.extrinsics), height, width
            )
            points = unproject_maps(torch.from_numpy(view.depth), cameras).numpy()[view.mask]
            assert (points > body.min(0) - 0.05).all()
            assert (points < body.max(0) + 0.05).all()
