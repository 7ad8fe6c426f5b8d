"""ZJU-MoCap and HuMMan-Recon: common behaviour and peculiarities of their formats, on miniatures."""

import json
import pickle
import shutil
import sys
from functools import partial
from pathlib import Path, PurePosixPath

import numpy as np
import pytest
from PIL import Image
from scipy import sparse

from ghgs_lit.data.humman import HuMMan, body_vertices, load_model, read_model
from ghgs_lit.data.pickles import load_npy
from ghgs_lit.data.reader import Photographs
from ghgs_lit.data.sampling import CAMERAS
from ghgs_lit.data.view import half_centers
from ghgs_lit.data.zju_mocap import ZJUMoCap, frame_number, read_annotations
from ghgs_lit.errors import InputError
from ghgs_lit.geometry.undistortion import undistort, undistorting_grid
from scripts.miniatures.smpl import stand_in
from tests.helpers.captures import blob, build_data, centroid, inside, project, require_same_packed

OPENCV = np.load(Path(__file__).parents[1] / "fixtures" / "opencv_camera.npz")
HUMMAN = "p000455_a000986"
#: By data set: folder of a sequence, and paths of the image and mask of camera 7 in it.
FILES = {
    "zju_mocap": ("CoreView_386", "Camera_B8/000000.jpg", "mask_cihp/Camera_B8/000000.png"),
    "humman": (HUMMAN, *(f"kinect_{kind}/kinect_007/000000.png" for kind in ("color", "mask"))),
}
each = pytest.mark.parametrize("kind", FILES)


def of_zju(root: Path, sequence: str = "386", frames=(0, 2, 1), size=None) -> Photographs:
    split = {key: [{"sequences": [sequence], "frames": list(frames)}] for key in ("train", "val")}
    return Photographs(ZJUMoCap(root=root, split=split).reader("val"), size)


def of_humman(root: Path, size=None, **options) -> Photographs:
    return Photographs(HuMMan(root=root, split={"val": [HUMMAN]}, **options).reader("val"), size)


READERS = {"zju_mocap": of_zju, "humman": of_humman}


@pytest.fixture
def roots(zju_root, humman_root) -> dict[str, Path]:
    return {"zju_mocap": zju_root, "humman": humman_root}


@pytest.fixture
def copy(zju_root, tmp_path):
    """Copies a sequence of ZJU-MoCap below ``tmp_path``; ``change`` changes its annotations."""

    def make(sequence="386", change=None) -> Path:
        folder = shutil.copytree(zju_root / f"CoreView_{sequence}", tmp_path / f"CoreView_{sequence}")
        if change is not None:
            content = load_npy(folder / "annots.npy")
            change(content)
            np.save(folder / "annots.npy", content)
        return folder

    return make


def set_lenses(content: dict, shape=(5, 1), scale=0) -> None:
    count = np.prod(shape)
    content["cams"]["D"] = [scale * np.ravel(d)[:count].reshape(shape) for d in content["cams"]["D"]]


@pytest.mark.parametrize("name", ["386", "313", "humman"])
def test_bodies_project_into_every_mask(zju_root, humman_root, name):
    """Cameras, bodies and masks of both generations agree, after undistortion, and SMPL's parameters fit."""
    if name == "humman":
        pytest.importorskip("smplx")
        data = of_humman(humman_root, smpl_model=humman_root.with_name("recon_body_models"))
    else:
        data = of_zju(zju_root, name)
    for subject, cameras in data.reader.subjects.items():
        body = data.reader.read_checked_body(subject)
        assert body.shape == (6890, 3)
        assert min(inside(data.view(subject, k), body) for k in cameras) > 0.97


@each
def test_the_background_is_black(roots, kind):
    """The studio behind the performer must not be visible to the model."""
    view = READERS[kind](roots[kind]).view(f"{FILES[kind][0]}_000000", 2)
    assert view.image[~view.mask].max() == 0
    assert view.image[view.mask].max() > 60


@pytest.mark.parametrize(("camera", "mode"), [(0, "L"), (3, "RGB")])
def test_any_label_is_the_performer(copy, camera, mode):
    """Label maps have many labels in one or three channels, and all except 0 are the performer."""
    folder = copy(change=set_lenses)
    image = Image.open(folder / f"mask_cihp/Camera_B{camera + 1}/000000.png")
    labels = np.asarray(image).reshape(*image.size, -1)[..., 0]
    assert image.mode == mode
    assert 0 < labels.max() < 20
    found = of_zju(folder.parent).view("CoreView_386_000000", camera).mask
    np.testing.assert_array_equal(found, labels > 0)


def test_any_value_of_the_matting_is_the_performer(humman_root):
    """Low values of the matting are the performer, too."""
    path = humman_root / HUMMAN / "kinect_mask" / "kinect_002" / "000006.png"
    matting = np.asarray(Image.open(path))
    assert ((matting > 0) & (matting < 128)).any()
    np.testing.assert_array_equal(of_humman(humman_root).view(f"{HUMMAN}_000006", 2).mask, matting > 0)


def opencv_camera(kind: str, folder: Path, number: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Stored K, R and T of a camera, T in metres."""
    if kind == "humman":
        camera = json.loads((folder / "cameras.json").read_text())[f"kinect_color_{number:03d}"]
        return tuple(np.array(camera[key]) for key in "KRT")
    cams = load_npy(folder / "annots.npy")["cams"]
    return cams["K"][number], cams["R"][number], cams["T"][number][:, 0] / 1000


@each
@pytest.mark.parametrize("share", [1, 2, 4])
def test_intrinsics_fit_resized_photographs(humman_root, copy, tmp_path, kind, share):
    """A spot drawn where OpenCV's camera projects a point is where the view's camera projects it."""
    sequence, photograph, mask = FILES[kind]
    if kind == "humman":
        folder = shutil.copytree(humman_root / sequence, tmp_path / sequence)
    else:
        folder = copy(change=set_lenses)
    matrix, rotation, translation = opencv_camera(kind, folder, 7)
    _, first, offset = opencv_camera(kind, folder, 0)
    point = first.T @ (np.array([0.03, 0.1, 2.4]) - offset)
    x, y, z = matrix @ (rotation @ point + translation)
    height, width = np.asarray(Image.open(folder / photograph)).shape[:2]
    Image.fromarray(blob(height, width, x / z, y / z)).save(folder / photograph, quality=100)
    Image.fromarray(np.full((height, width), 7, np.uint8)).save(folder / mask)
    size = (height // share, width // share)
    view = READERS[kind](tmp_path, size=size).view(f"{sequence}_000000", 7)
    assert view.image.shape == (*size, 3)
    np.testing.assert_allclose(centroid(view.image), project(view, point), atol=0.03)


@each
def test_targets_between_cameras_that_stand_still_are_refused(roots, kind):
    """Views that do not exist are rejected before anything is read."""
    split = "data.split={train: [{sequences: [386], FRAMES}], val: [{sequences: [386], FRAMES}]}"
    splits = [split.replace("FRAMES", "frames: [0, 2, 1]")] if kind == "zju_mocap" else []
    module = build_data(kind, roots[kind], *splits, "targets=release", "data.workers=0")
    midway = partial(module.evaluation_loader, targets={"name": "midway"})
    for draw in (module.training_sampler, module.evaluation_loader, midway):
        with pytest.raises(InputError, match=rf"targets: expected cameras for data={kind}.*; found"):
            draw()
    assert len(module.evaluation_loader(targets=CAMERAS)) > 0


@pytest.mark.parametrize("name", ["386", "313", "humman"])
def test_packed_frames_are_the_same(zju_root, humman_root, tmp_path, name):
    reader = of_humman(humman_root).reader if name == "humman" else of_zju(zju_root, name).reader
    require_same_packed(reader, tmp_path, (64, 48))


def test_undistortion_is_that_of_opencv():
    """Undistortion agrees with recorded results of OpenCV, with which the data sets were calibrated."""
    height, width = OPENCV["image"].shape[:2]
    grid = undistorting_grid(half_centers(OPENCV["intrinsics"]), OPENCV["distortion"].ravel(), height, width)
    image, mask = undistort(OPENCV["image"], np.full((height, width), 255, np.uint8), grid)
    error = np.abs(image.astype(int) - OPENCV["undistorted"])
    assert error.mean() < 0.3
    assert error.max() <= 4  # OpenCV rounds places to 1/32 px
    assert np.abs(OPENCV["image"].astype(int) - OPENCV["undistorted"]).mean() > 20
    assert mask.min() == 0


def test_photographs_are_undistorted_about_their_own_pixel_centers(zju_root):
    """Calibrations have pixel centres at integers; an offset of half a pixel would undistort wrongly."""
    folder = zju_root / "CoreView_386"
    cameras, frames = read_annotations(folder / "annots.npy")
    image = np.asarray(Image.open(folder / frames[0][7]).convert("RGB"))
    labels = np.asarray(Image.open((folder / "mask_cihp" / frames[0][7]).with_suffix(".png")))
    mask = labels.reshape(*image.shape[:2], -1)[..., 0] > 0
    lens = half_centers(cameras[7].intrinsics), cameras[7].distortion
    straight, matte = undistort(image, mask * np.uint8(255), undistorting_grid(*lens, *image.shape[:2]))
    view = of_zju(zju_root).view("CoreView_386_000000", 7)
    np.testing.assert_array_equal(view.mask, matte > 127)
    np.testing.assert_array_equal(view.image, np.where(view.mask[..., None], straight, 0))


@pytest.mark.parametrize(("sequence", "numbers"), [("386", (0, 1)), ("313", (1, 2))])
def test_old_sequences_count_frames_from_one(zju_root, sequence, numbers):
    """Sequences 313 and 315 number their frames from 1; each frame has the first 20 cameras."""
    reader = of_zju(zju_root, sequence).reader
    assert reader.subjects == {f"CoreView_{sequence}_{n:06d}": tuple(range(20)) for n in numbers}
    files = zju_root / f"CoreView_{sequence}" / "new_vertices"
    assert {int(path.stem) for path in files.iterdir()} == set(numbers)
    stored = np.load(files / f"{numbers[0]}.npy")
    np.testing.assert_array_equal(reader.read_checked_body(next(iter(reader.subjects))), stored)


@pytest.mark.parametrize("patterns", [["Camera*/*.jpg"], ["mask*/Camera*/*.png"], ["Camera*/*", "mask*/*/*"]])
def test_old_sequences_are_read_with_long_and_short_names(zju_root, copy, patterns):
    """Files of 313 and 315 are found under their original and their short names."""
    folder = copy("313")
    assert len(next(folder.glob("Camera (22)/*.jpg")).stem.split("_")) == 7
    for pattern in patterns:
        for path in folder.glob(pattern):
            path.rename(path.with_name(path.stem.split("_")[4] + path.suffix))
    one, other = (of_zju(place, "313").view("CoreView_313_000002", 19) for place in (zju_root, folder.parent))
    np.testing.assert_array_equal(one.image, other.image)
    np.testing.assert_array_equal(one.mask, other.mask)


@pytest.mark.parametrize(
    ("name", "number"),
    [
        ("Camera (1)/CoreView_313_Camera_(1)_0001_2019-08-23_16-08-50.592.jpg", 1),
        ("Camera (1)/0001.jpg", 1),
        ("Camera_B1/000000.jpg", 0),
        ("Camera_B23/000616.jpg", 616),
    ],
)
def test_frame_numbers_are_of_both_generations(name, number):
    """The frame number is read from names of both generations."""
    assert frame_number(PurePosixPath(name)) == number


def use_backslashes(content: dict) -> None:
    for frame in content["ims"]:
        frame["ims"] = [name.replace("/", "\\") for name in frame["ims"]]


def test_names_of_windows_are_read(copy):
    """Some published annotations use backslashes."""
    folder = copy(change=use_backslashes)
    assert of_zju(folder.parent).view("CoreView_386_000000", 0).mask.any()


@pytest.mark.parametrize("shape", [(4,), (5,), (5, 1), (1, 5)])
def test_lens_coefficients_of_any_shape_are_read(copy, shape):
    """Coefficients are stored in several shapes."""
    folder = copy(change=partial(set_lenses, shape=shape, scale=1))
    cameras, _ = read_annotations(folder / "annots.npy")
    assert len(cameras[0].distortion) == np.prod(shape)


def test_the_new_fit_is_preferred(copy):
    """The better fit is read where it exists, else the other, else none; a frame without a body has none."""
    folder = copy()
    fits = [np.load(folder / kind / "0.npy") for kind in ("new_vertices", "vertices")]
    assert np.abs(fits[0] - fits[1]).max() > 0.002
    for kind, fit in zip(("new_vertices", "vertices"), fits, strict=True):
        found = of_zju(folder.parent).reader.read_checked_body("CoreView_386_000000")
        np.testing.assert_array_equal(found, fit)
        (folder / kind / "0.npy").unlink()
        assert of_zju(folder.parent).reader.read_checked_body("CoreView_386_000000") is None
        shutil.rmtree(folder / kind)
    assert of_zju(folder.parent).reader.read_checked_body("CoreView_386_000000") is None


def test_frames_are_places_in_the_annotations(zju_root):
    """Frames are indices in annots.npy, not frame numbers; a start beyond the end raises."""
    assert list(of_zju(zju_root, frames=(1, 500, 5)).reader.subjects) == ["CoreView_386_000001"]
    assert list(of_zju(zju_root, frames=(0, 500, 5)).reader.subjects) == ["CoreView_386_000000"]
    with pytest.raises(InputError, match="expected a frame 700; found 2 frames"):
        of_zju(zju_root, frames=(700, 1000, 6))


def test_the_default_split_is_sherfs(zju_root):
    """The shipped configuration has SHERF's split, which the paper uses."""
    split = build_data("zju_mocap", zju_root).dataset.split
    assert [s.sequences for s in split.train] == [("386", "387", "390", "392", "393", "394")]
    assert [s.sequences for s in split.val] == [("377", "313", "315")]
    assert len(range(*split.train[0].frames)) == 100
    assert list(range(*split.val[0].frames)) == list(range(0, 500, 20))


def test_batches_have_the_protocols_cameras(zju_root):
    """For 3 views inputs are 0 7 15 and targets all 17 other cameras."""
    data = build_data("zju_mocap", zju_root, "data.size=64", "data.workers=0", "views=v3")
    batch = data.training_batch(0)
    assert batch.images.shape == (1, 3, 3, 64, 64)
    assert batch.targets.images.shape == (1, 1, 3, 64, 64)
    assert batch.body_vertices[0].shape == (6890, 3)
    samples = list(data.evaluation_loader(views=3))
    assert samples[0].views == (("000/0", "007/0", "015/0"),)
    assert [len(names) for sample in samples for names in sample.targets.names] == [17]


def test_a_camera_that_lacks_a_frame_is_left_out(humman_root, tmp_path, caplog):
    """Frames that a sequence lacks are skipped; a missing image removes one camera from its frame only."""
    shutil.copytree(humman_root / HUMMAN, tmp_path / HUMMAN)
    (tmp_path / HUMMAN / "kinect_color" / "kinect_004" / "000006.png").unlink()
    whole = tuple(range(10))
    cameras = {0: whole, 6: (0, 1, 2, 3, 5, 6, 7, 8, 9), 18: whole}
    assert of_humman(tmp_path).reader.subjects == {f"{HUMMAN}_{n:06d}": k for n, k in cameras.items()}
    assert [record.getMessage().partition(": ")[2] for record in caplog.records if "lacks" in record.msg] == [
        "frame 000006 lacks kinects [4], left out"
    ]


def test_named_sequences_are_for_testing_and_the_rest_for_training(humman_root, tmp_path):
    """The official test sequences never reach training."""
    shutil.copytree(humman_root, tmp_path / "recon")
    (tmp_path / "recon" / "notes").mkdir()
    data = build_data("humman", tmp_path / "recon").dataset
    assert len(data.split.val) == len(set(data.split.val)) == 22
    assert data.sequences("train") == ["p100001_a000048"]
    assert {frame.folder.name for frame in data.reader("val").frames.values()} == {HUMMAN}


def test_evaluation_takes_evenly_spaced_inputs_and_all_other_targets(humman_root):
    """Inputs are 0 3 6 and there are seven targets; without a body model there are no bodies."""
    data = build_data("humman", humman_root, "data.size=[36,64]", "data.workers=0")
    batch = data.training_batch(0)
    assert batch.body_vertices is None
    assert batch.images.shape == (1, 4, 3, 36, 64)
    samples = list(data.evaluation_loader(views=3))
    assert len(samples) == 3
    assert samples[0].views == (("000/0", "003/0", "006/0"),)
    targets, others = samples[0].targets, (1, 2, 4, 5, 7, 8, 9)
    assert targets.names == (tuple(f"{k:03}/0" for k in others),)
    views = [of_humman(humman_root, size=(36, 64)).view(f"{HUMMAN}_000000", k) for k in others]
    images = (255 * targets.images[0].movedim(1, -1)).round()
    np.testing.assert_array_equal(images, [view.image for view in views])
    np.testing.assert_array_equal(targets.cameras.extrinsics[0], [view.extrinsics for view in views])


def test_smpl_turns_about_the_pelvis_and_then_shifts(humman_root):
    """The body rotates about the pelvis before it is translated, as SMPL defines."""
    pytest.importorskip("smplx")
    body, model = load_model(humman_root.with_name("recon_body_models")), stand_in()
    lengths = {"betas": 10, "body_pose": 69, "global_orient": 3, "transl": 3}
    still = {key: np.zeros(n) for key, n in lengths.items()}
    rest = body_vertices(body, still)
    np.testing.assert_allclose(rest, model["v_template"], atol=1e-5)
    moved = {"global_orient": np.array([0, np.pi, 0]), "transl": np.array([1.0, 2, 3])}
    turned = body_vertices(body, still | moved)
    pelvis = model["J_regressor"][0] @ model["v_template"]
    np.testing.assert_allclose(turned, (rest - pelvis) * [-1, 1, -1] + pelvis + [1, 2, 3], atol=1e-5)


class Ch:
    """Stand-in for chumpy's array, an object with its values under ``x``."""

    def __init__(self, x):
        self.x = x


@pytest.mark.parametrize("protocol", [0, 2])
def test_pickles_of_the_official_release_are_read_without_chumpy(tmp_path, monkeypatch, protocol):
    """The official file can be read without chumpy, which no longer installs."""
    module = type(sys)("chumpy.ch")
    module.Ch, Ch.__module__, Ch.__qualname__ = Ch, "chumpy.ch", "Ch"
    monkeypatch.setitem(sys.modules, "chumpy", type(sys)("chumpy"))
    monkeypatch.setitem(sys.modules, "chumpy.ch", module)
    arrays = stand_in()
    stored = {"shapedirs": Ch(arrays["shapedirs"]), "J_regressor": sparse.csc_matrix(arrays["J_regressor"])}
    path = tmp_path / "SMPL_NEUTRAL.pkl"
    path.write_bytes(pickle.dumps({**arrays, **stored, "bs_type": "lrotmin"}, protocol=protocol))
    monkeypatch.delitem(sys.modules, "chumpy.ch")
    read = read_model(path)
    for key, value in arrays.items():
        np.testing.assert_allclose(read[key], value)
