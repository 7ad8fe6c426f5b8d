"""The rendered layout: files written are read back, variants of other renderers are read, and bad files
are named."""

import os
import shutil
import unicodedata

import numpy as np
import pytest
from PIL import Image

from ghgs_lit.data.layout import Layout
from ghgs_lit.data.reader import Photographs
from ghgs_lit.data.sampling import subject_rng
from ghgs_lit.data.view import View, encode_depth
from ghgs_people.jobs import write_body, write_view
from ghgs_people.photograph import Studio
from tests.helpers.captures import points_of, refused, truncate
from tests.helpers.people import RIG, box_person

SIZE = 56


def write_person(root, name="box", size=SIZE, positions=(0, 4)) -> dict:
    """Write images of a box below ``root/train``; returns the images and cameras by position."""
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


def photographs(root, size=None, **options) -> Photographs:
    return Photographs(Layout(root, "train", **options), size)


@pytest.fixture(scope="module")
def box(tmp_path_factory):
    """The folder of a box, and the images and cameras written to it."""
    folder = tmp_path_factory.mktemp("box")
    return folder, write_person(folder)


@pytest.fixture
def root(box, tmp_path):
    return shutil.copytree(box[0], tmp_path / "box")


def on_box(view: View, person) -> np.ndarray:
    """Distances of unprojected depths from the surface of the box."""
    points = points_of(view)[view.mask & (view.depth > 0)]
    low, high = person.parts[0].vertices.min(0), person.parts[0].vertices.max(0)
    outside = np.maximum(np.maximum(low - points, points - high), 0)
    inside = np.minimum(points - low, high - points).min(-1)
    return np.linalg.norm(outside, axis=-1) + np.maximum(inside, 0)


def test_names_of_other_systems(tmp_path):
    """Folders and files with names as changed by Windows or macOS are read as before."""
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
    assert layout.reader.read_checked_body("K\u00e4the").shape == (8, 3)
    assert photographs(tmp_path, names=["K\u00e4the"]).reader.subjects == {"K\u00e4the": (0, 4)}


def test_round_trip(box):
    """Pixels, masks, depths, cameras and body are read back as written."""
    folder, written = box
    layout = photographs(folder)
    assert layout.reader.subjects == {"box": (0, 4)}
    person = RIG.place(box_person(), subject_rng(0, "box"))
    np.testing.assert_array_equal(layout.reader.read_checked_body("box"), person.body_vertices)
    for position, (shots, cameras) in written.items():
        view = layout.view("box", position, 0)
        assert np.abs(view.image / 255 - shots.images[0]).max() < 0.06
        np.testing.assert_array_equal(view.mask, shots.masks[0])
        # The authors' loader reads channel 0 of three.
        stored = np.asarray(Image.open(folder / f"train/mask/box_{position:03d}/0.png"))
        np.testing.assert_array_equal(stored, np.stack([shots.masks[0] * np.uint8(255)] * 3, -1))
        np.testing.assert_allclose(view.alpha, shots.alphas[0], atol=0.5 / 255 + 1e-6)
        assert ((view.alpha > 0) & (view.alpha < 1)).sum() > 50
        np.testing.assert_allclose(view.depth, shots.depths[0], atol=1.5e-4)
        np.testing.assert_allclose(view.intrinsics, cameras.intrinsics[0], rtol=1e-6)
        np.testing.assert_allclose(view.extrinsics, cameras.extrinsics[0], atol=1e-6)
        assert np.quantile(on_box(view, person), 0.95) < 1e-3


def test_depth_code_is_inverse_and_keeps_zero():
    """Inverse depth is 2^15 / metres in 16 bits, saturates, and keeps 0 for unknown."""
    depth = np.array([0.0, 0.25, 1.0, 2.0, 3.0], np.float32)
    code = encode_depth(depth)
    assert code.tolist() == [0, 65535, 32768, 16384, 10923]


@pytest.mark.parametrize("size", [(28, 28), (28, 42), (112, 84), (30, 21)])
def test_resized_views_keep_their_geometry(root, size):
    """Unprojected depths of a resized view still lie on the mesh, and intrinsics scale exactly."""
    view = photographs(root, size).view("box", 0, 0)
    assert view.image.shape == (*size, 3)
    assert view.mask.shape == view.depth.shape == size
    person = RIG.place(box_person(), subject_rng(0, "box"))
    # Depth can be off by at most half a source pixel, 2 cm, along a surface.
    assert np.quantile(on_box(view, person), 0.9) < 0.015
    scale = np.array([size[1] / SIZE, size[0] / SIZE, 1])
    original = photographs(root).view("box", 0, 0)
    np.testing.assert_allclose(view.intrinsics, original.intrinsics * scale[:, None], rtol=1e-6)
    # Equal to the rig's camera resized to this size.
    camera = RIG.cameras(np.zeros(1), SIZE, SIZE).resize(*size)
    np.testing.assert_allclose(view.intrinsics, camera.intrinsics[0], rtol=1e-5)


def test_renders_of_others_are_read(root):
    """Variants are read: PNG images, masks with three channels of 0/1, no depth, only smplx, 4 x 4 poses,
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
    assert len(layout.reader.read_checked_body("box")) == 8
    np.testing.assert_allclose(view.intrinsics[:2, 2], ours.intrinsics[:2, 2] + 0.5, rtol=1e-6)
    half = photographs(root, (28, 28), pixel_centers="integer").view("box", 0, 0)
    np.testing.assert_allclose(half.intrinsics[:2, 2], (ours.intrinsics[:2, 2] + 0.5) / 2, rtol=1e-6)


@pytest.mark.parametrize("size", [(28, 28), (30, 21)])
def test_mattes_are_resized_as_photographs_and_masks_follow(root, size):
    """Resizing keeps the mean matte; masks are true where it is at least half, and depths known only where
    it is above 0."""
    full, small = photographs(root).view("box", 0, 0), photographs(root, size).view("box", 0, 0)
    assert small.alpha.mean() == pytest.approx(full.alpha.mean(), abs=1e-3)
    np.testing.assert_array_equal(small.mask, small.matte >= 128)
    assert not small.depth[small.matte == 0].any()
    assert (small.depth[small.mask] > 0).all()
    # Divided by its matte, the rim has the colour of the box.
    rim = (small.matte > 64) & (small.matte < 255)
    own, color = small.image[rim].astype(float), small.image[small.matte == 255].mean(0)
    assert len(own) > 20
    error, dark = own / small.alpha[rim][:, None] - color, own - color
    assert np.abs(error).mean() < 0.25 * np.abs(dark).mean()


def test_data_without_mattes_is_read_as_before(root):
    """Without the optional matte, the subject's mask, image and depth are the same."""
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


def picture(kind: str, array, suffix: str = "png"):
    """A damage that replaces an image of a kind."""
    return lambda train: Image.fromarray(array).save(train / kind / f"box_000/0.{suffix}")


def camera(kind: str, change):
    """A damage that applies ``change`` to a matrix."""

    def apply(train):
        path = train / "parm" / "box_000" / f"0_{kind}.npy"
        np.save(path, change(np.load(path)))

    return apply


def content(path: str, data: bytes):
    return lambda train: (train / path).write_bytes(data)


def remove(path: str):
    return lambda train: (train / path).unlink()


IMAGE, MASK, MATRIX = "img/box_000/0.jpg", "mask/box_000/0.png", "parm/box_000/0_intrinsic.npy"
ZEROS, SMALL = np.zeros((SIZE, SIZE), np.uint8), np.zeros((30, 20), np.uint8)
OF_PHOTOGRAPH = "expected the size of its photograph, 56x56; found 30x20"
DAMAGES = [
    (remove(IMAGE), r"box_000/0\.jpg: expected an image; found no such file"),
    (lambda train: truncate(train / IMAGE, 0.2), r"box_000/0\.jpg: expected a readable image; found"),
    (content(IMAGE, b"no image"), r"box_000/0\.jpg: expected a readable image; found"),
    (remove(MASK), r"mask/box_000/0\.png: expected an image; found no such file"),
    (picture("mask", SMALL), rf"mask/box_000/0\.png: {OF_PHOTOGRAPH}"),
    (picture("depth", ZEROS), r"depth/box_000/0\.png: expected 16 bits of inverse depth; found 'uint8'"),
    (
        picture("alpha", ZEROS.astype(np.uint16)),
        r"alpha/box_000/0\.png: expected 8 bits of grey; found 'uint16'",
    ),
    (picture("alpha", ZEROS), r"mask/box_000/0\.png: expected a subject in the mask; found none"),
    (picture("alpha", SMALL), rf"alpha/box_000/0\.png: {OF_PHOTOGRAPH}"),
    (
        camera("intrinsic", lambda k: k * [[0, 1, 1], [1, 1, 1], [1, 1, 1]]),
        r"0_intrinsic\.npy: expected focal lengths above 0; found 0\.0",
    ),
    (camera("extrinsic", lambda e: e * np.nan), r"0_extrinsic\.npy: expected finite numbers; found NaN"),
    (camera("extrinsic", lambda e: e[:2]), r"0_extrinsic\.npy: expected an array 3x4 or 4x4; found 2x4"),
    (
        camera("extrinsic", lambda e: e * [2, 2, 2, 1]),
        r"0_extrinsic\.npy: expected a rotation in the first three columns; found",
    ),
    (
        content(MATRIX, b"\x93NUMPY garbage"),
        r"0_intrinsic\.npy: expected an array 3x3; found a file that cannot be read",
    ),
    (remove(MATRIX), r"0_intrinsic\.npy: expected an array 3x3; found no such file"),
]


@pytest.mark.parametrize(("damage", "line"), DAMAGES)
def test_bad_files_are_named(root, damage, line):
    """Each defect of a file raises one line with its path."""
    damage(root / "train")
    refused(line, lambda: photographs(root).view("box", 0, 0))


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
    refused(rf"box/vertices\.npy: {message}", lambda: photographs(root).reader.read_checked_body("box"))


@pytest.mark.parametrize(
    ("folder", "names", "line"),
    [
        ("nowhere", None, "nowhere: expected the root of a rendered data set; found no such folder"),
        ("empty", None, "train/img: expected a folder <id>_<position>"),
        ("other", None, "expected folders <id>_<position>; found none"),
        ("other", ["x"], r"found 0 \(x is missing"),
    ],
)
def test_missing_roots_and_phases(tmp_path, folder, names, line):
    """A wrong root, an empty phase and a missing subject are named."""
    (tmp_path / "empty").mkdir()
    (tmp_path / "other" / "train" / "img" / "unrelated").mkdir(parents=True)
    refused(line, lambda: Layout(tmp_path / folder, "train", names=names))


def test_a_half_rendered_subject_is_refused(root):
    """In data rendered by this package, a subject without its marker is incomplete."""
    (root / "rendering" / "done" / "train").mkdir(parents=True)
    line = r"expected 1 whole subjects; found 0 \(box is missing or half-rend"
    refused(line, lambda: Layout(root, "train"))
    (root / "rendering" / "done" / "train" / "box").touch()
    assert list(Layout(root, "train").subjects) == ["box"]


def test_a_mask_is_where_it_is_above_half_of_its_maximum(root):
    """The threshold tolerates compression, with small values outside the subject and various values on it,
    and masks with one channel."""
    path = root / "train" / "mask" / "box_000" / "0.png"
    mask = np.asarray(Image.open(path))[..., 0] > 0
    noise = np.random.default_rng(0).integers(0, 30, mask.shape)
    Image.fromarray(np.where(mask, 250 - noise, noise).astype(np.uint8)).save(path)
    np.testing.assert_array_equal(photographs(root).view("box", 0, 0).mask, mask)
