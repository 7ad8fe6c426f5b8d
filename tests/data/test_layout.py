"""The rendered layout: what is written is read back, others' variants too,
and bad files are named."""

import os
import shutil
import unicodedata

import numpy as np
import pytest
import torch
from PIL import Image

from ghgs_lit.data.layout import Layout
from ghgs_lit.data.reader import PhotographCache
from ghgs_lit.data.sampling import subject_rng
from ghgs_lit.data.view import View, encode_depth
from ghgs_lit.errors import InputError
from ghgs_lit.geometry.projection import unproject_maps
from ghgs_lit.types import Cameras
from ghgs_people.jobs import write_body, write_view
from ghgs_people.photograph import Studio
from tests.helpers.people import RIG, box_person

SIZE = 56


def write_person(root, name="box", size=SIZE, positions=(0, 4)) -> dict:
    """Photographs of a box, written below ``root/train``; what went in, by position."""
    person = RIG.place(box_person(name), subject_rng(0, name))
    studio = Studio(person, None)
    written = {}
    for position in positions:
        cameras = RIG.cameras(np.array([22.5 * position]), size, size)
        photographs = studio.shoot(cameras)
        image = np.round(photographs.images[0] * 255).astype(np.uint8)
        inverse = encode_depth(photographs.depths[0])
        camera = cameras.intrinsics[0].numpy(), cameras.extrinsics[0].numpy()
        matte = np.round(photographs.alphas[0] * 255).astype(np.uint8)
        view = View(image, photographs.masks[0], inverse, *camera, matte)
        write_view(root / "train", f"{name}_{position:03d}", 0, view)
        written[position] = (photographs, cameras)
    write_body(root / "train", name, person.body_vertices)
    return written


def photographs(root, size=None, cache_mb=0, **options) -> PhotographCache:
    return PhotographCache(Layout(root, "train", **options), size, cache_mb)


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


def test_names_of_other_systems(tmp_path):
    """Folders and files that Windows or macOS renamed, all of them, hold what they held."""
    write_person(tmp_path, "K\u00e4the")
    right = photographs(tmp_path).view("K\u00e4the", 4, 0)
    for path in sorted(tmp_path.rglob("*"), key=lambda path: -len(path.parts)):
        upper = path.with_suffix(path.suffix.upper()) if path.suffix else path
        path.rename(upper.with_name(unicodedata.normalize("NFD", upper.name)))
    layout = photographs(tmp_path)
    assert layout.reader.views_at("K\u00e4the", 0) == [0]
    found = layout.view("K\u00e4the", 4, 0)
    for name in ("image", "mask", "inverse_depth", "matte", "intrinsics", "extrinsics"):
        np.testing.assert_array_equal(getattr(found, name), getattr(right, name))
    assert layout.body("K\u00e4the").shape == (8, 3)
    assert photographs(tmp_path, names=["K\u00e4the"]).reader.subjects == {"K\u00e4the": (0, 4)}


def test_round_trip(tmp_path):
    """What is written is read back: pixels, masks, depth, cameras and body."""
    written = write_person(tmp_path)
    layout = photographs(tmp_path)
    assert layout.reader.subjects == {"box": (0, 4)}
    person = RIG.place(box_person(), subject_rng(0, "box"))
    np.testing.assert_array_equal(layout.body("box"), person.body_vertices)
    for position, (shots, cameras) in written.items():
        view = layout.view("box", position, 0)
        assert np.abs(view.image / 255 - shots.images[0]).max() < 0.06
        np.testing.assert_array_equal(view.mask, shots.masks[0])
        # The authors' loader takes channel 0 of three.
        stored = np.asarray(Image.open(tmp_path / f"train/mask/box_{position:03d}/0.png"))
        np.testing.assert_array_equal(stored, np.stack([shots.masks[0] * np.uint8(255)] * 3, -1))
        np.testing.assert_allclose(view.alpha, shots.alphas[0], atol=0.5 / 255 + 1e-6)
        assert ((view.alpha > 0) & (view.alpha < 1)).sum() > 50
        np.testing.assert_allclose(view.depth, shots.depths[0], atol=1.5e-4)
        np.testing.assert_allclose(view.intrinsics, cameras.intrinsics[0], rtol=1e-6)
        np.testing.assert_allclose(view.extrinsics, cameras.extrinsics[0], atol=1e-6)
        assert np.quantile(on_box(view, person), 0.95) < 1e-3


def test_depth_code_is_inverse_and_keeps_zero():
    """The 16-bit code is 2^15 / metres, saturates, and keeps 0 for unknown."""
    depth = np.array([0.0, 0.25, 1.0, 2.0, 3.0], np.float32)
    code = encode_depth(depth)
    assert code.tolist() == [0, 65535, 32768, 16384, 10923]


@pytest.mark.parametrize("size", [(28, 28), (28, 42), (112, 84), (30, 21)])
def test_resized_views_keep_their_geometry(root, size):
    """Unprojected depth of a resized view still lies on the mesh:
    intrinsics follow pixels exactly."""
    view = photographs(root, size).view("box", 0, 0)
    assert view.image.shape == (*size, 3)
    assert view.mask.shape == view.depth.shape == size
    person = RIG.place(box_person(), subject_rng(0, "box"))
    # Nearest depth is off by at most half a source pixel, 2 cm, along a surface.
    assert np.quantile(on_box(view, person), 0.9) < 0.015
    scale = np.array([size[1] / SIZE, size[0] / SIZE, 1])
    original = photographs(root).view("box", 0, 0)
    np.testing.assert_allclose(view.intrinsics, original.intrinsics * scale[:, None], rtol=1e-6)
    # A larger camera of the same rig is the same camera.
    camera = RIG.cameras(np.zeros(1), SIZE, SIZE).resized(*size)
    np.testing.assert_allclose(view.intrinsics, camera.intrinsics[0], rtol=1e-5)


def test_halving_averages_areas(root):
    """Downscaling takes the mean over the area, without aliasing."""
    full, half = photographs(root).view("box", 0, 0), photographs(root, (28, 28)).view("box", 0, 0)
    mean = full.image.reshape(28, 2, 28, 2, 3).mean((1, 3))
    assert np.abs(half.image - mean).max() <= 1  # two passes, each rounded


def test_renders_of_others_are_read(root):
    """PNG photographs, masks of three channels with 0/1, no depth, smplx only, 4 x 4 poses,
    hr images."""
    ours = photographs(root, pixel_centers="half").view("box", 0, 0)
    img, mask, depth, parm = (root / "train" / k / "box_000" for k in ("img", "mask", "depth", "parm"))
    Image.open(img / "0.jpg").save(img / "0.png")
    shutil.copy(img / "0.jpg", img / "2_hr.jpg")
    (img / "0.jpg").unlink()
    binary = (np.asarray(Image.open(mask / "0.png"))[..., 0] > 0).astype(np.uint8)
    Image.fromarray(np.stack([binary, 0 * binary, 0 * binary], -1)).save(mask / "0.png")
    shutil.rmtree(depth)
    extrinsic = np.load(parm / "0_extrinsic.npy")
    np.save(parm / "0_extrinsic.npy", np.concatenate((extrinsic, [[0, 0, 0, 1]])))
    os.rename(root / "train" / "smpl", root / "train" / "smplx")
    layout = photographs(root, pixel_centers="integer")
    view = layout.view("box", 0, 0)
    np.testing.assert_array_equal(view.image, ours.image)
    np.testing.assert_array_equal(view.mask, ours.mask)
    np.testing.assert_array_equal(view.extrinsics, ours.extrinsics)
    assert view.depth is None
    assert layout.reader.views_at("box", 0) == [0]
    assert len(layout.body("box")) == 8
    np.testing.assert_allclose(view.intrinsics[:2, 2], ours.intrinsics[:2, 2] + 0.5, rtol=1e-6)
    half = photographs(root, (28, 28), pixel_centers="integer").view("box", 0, 0)
    np.testing.assert_allclose(half.intrinsics[:2, 2], (ours.intrinsics[:2, 2] + 0.5) / 2, rtol=1e-6)


@pytest.mark.parametrize("size", [(28, 28), (30, 21)])
def test_mattes_are_resized_as_photographs_and_masks_follow(root, size):
    """The share of the subject stays; masks are where it fills a half,
    depths where it shows at all."""
    full, small = photographs(root).view("box", 0, 0), photographs(root, size).view("box", 0, 0)
    assert small.alpha.mean() == pytest.approx(full.alpha.mean(), abs=1e-3)
    np.testing.assert_array_equal(small.mask, small.matte >= 128)
    assert not small.depth[small.matte == 0].any()
    assert (small.depth[small.mask] > 0).all()
    # The colour of the box is known where the image is divided by its matte.
    rim = (small.matte > 64) & (small.matte < 255)
    own, color = small.image[rim].astype(float), small.image[small.matte == 255].mean(0)
    assert len(own) > 20
    error, dark = own / small.alpha[rim][:, None] - color, own - color
    assert np.abs(error).mean() < 0.25 * np.abs(dark).mean()


def test_data_without_mattes_is_read_as_before(root):
    """The matte is optional: mask, image and depth of the subject are the same without it."""
    soft = photographs(root).view("box", 0, 0)
    shutil.rmtree(root / "train" / "alpha")
    plain = photographs(root).view("box", 0, 0)
    assert plain.matte is None
    assert plain.alpha is None
    np.testing.assert_array_equal(plain.mask, soft.mask)
    for name in ("image", "depth", "intrinsics", "extrinsics"):
        np.testing.assert_array_equal(getattr(plain, name), getattr(soft, name), err_msg=name)
    small = photographs(root, (28, 28)).view("box", 0, 0)
    assert small.matte is None
    share = plain.mask.reshape(28, 2, 28, 2).mean((1, 3))
    np.testing.assert_array_equal(small.mask, share >= 0.5)
    np.testing.assert_array_equal(small.depth > 0, small.mask)


def test_masks_of_one_channel_are_read(root):
    """Data that was rendered before masks had three channels stays readable."""
    before = photographs(root).view("box", 0, 0).mask
    path = root / "train" / "mask" / "box_000" / "0.png"
    Image.open(path).convert("L").save(path)
    np.testing.assert_array_equal(photographs(root).view("box", 0, 0).mask, before)


def test_cache_keeps_what_fits_and_no_more(root):
    """The cache respects its limit and drops the least recently used first."""
    layout = photographs(root, cache_mb=2 * (SIZE * SIZE * 7 + 1024) / 2**20)
    first = layout.view("box", 0, 0)
    assert layout.view("box", 0, 0) is first
    layout.view("box", 4, 0)
    layout.body("box")  # the third thing: the oldest goes
    assert layout.view("box", 0, 0) is not first
    assert layout.cached_bytes <= layout.cache_bytes
    nothing = photographs(root)
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
    alpha = root / "train" / "alpha" / "box_000" / "0.png"
    if kind == "matte of 16 bits":
        Image.fromarray(np.zeros((SIZE, SIZE), np.uint16)).save(alpha)
        return r"alpha/box_000/0\.png: expected 8 bits of grey; found uint16"
    if kind in ("matte of zeros", "depth of zeros"):
        path, dtype = (alpha, np.uint8) if kind == "matte of zeros" else (depth / "0.png", np.uint16)
        Image.fromarray(np.zeros((SIZE, SIZE), dtype)).save(path)
        return r"box_000/0\.png: expected .* above 0 at the subject; found '0 everywhere'"
    if kind == "matte size":
        Image.new("L", (20, 30)).save(alpha)
        return r"alpha/box_000/0\.png: expected the size of its photograph, 56x56; found 30x20"
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
    "matte of 16 bits",
    "matte size",
    "matte of zeros",
    "depth of zeros",
]
BAD_CAMERAS = ["zero focal", "nan camera", "camera shape", "no rotation", "camera garbage", "camera missing"]


@pytest.mark.parametrize("kind", BAD_IMAGES + BAD_CAMERAS)
def test_bad_files_are_named(root, kind):
    """Every defect of a file is reported in one line with its path."""
    pattern = damage(root, kind)
    with pytest.raises(InputError, match=pattern) as caught:
        photographs(root).view("box", 0, 0)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("vertices", "message"),
    [
        (np.zeros((0, 3)), "expected vertices; found 'none'"),
        (np.full((4, 3), 1e30), "expected coordinates below 1e.06; found 1e.30"),
        (np.zeros((4, 3), "datetime64[s]"), "expected an array nx3; found numbers of type datetime64"),
        (np.zeros((4, 3), complex), "expected an array nx3; found numbers of type complex"),
    ],
)
def test_bodies_of_no_person_are_named(root, vertices, message):
    np.save(root / "train" / "smpl" / "box" / "vertices.npy", vertices)
    with pytest.raises(InputError, match=rf"box/vertices\.npy: {message}"):
        photographs(root).body("box")


def test_missing_roots_and_phases(tmp_path):
    """A wrong root, an empty phase and a missing subject are named."""
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


def test_a_half_rendered_subject_is_refused(root):
    """Where this package renders, a subject without its mark is not whole."""
    (root / "rendering" / "done" / "train").mkdir(parents=True)
    with pytest.raises(InputError, match=r"expected 1 whole subjects; found 0 \(box is missing or half-rend"):
        Layout(root, "train")
    lenient = Layout(root, "train", strict=False)
    assert not lenient.subjects
    assert "half-rendered" in str(lenient.problems[0])
    (root / "rendering" / "done" / "train" / "box").touch()
    assert list(Layout(root, "train").subjects) == ["box"]


def test_a_mask_is_where_it_is_above_half_of_its_maximum(root):
    """Compression leaves small values beside the subject, and others than the largest on it."""
    path = root / "train" / "mask" / "box_000" / "0.png"
    mask = np.asarray(Image.open(path))[..., 0] > 0
    noise = np.random.default_rng(0).integers(0, 30, mask.shape)
    Image.fromarray(np.where(mask, 250 - noise, noise).astype(np.uint8)).save(path)
    np.testing.assert_array_equal(photographs(root).view("box", 0, 0).mask, mask)
