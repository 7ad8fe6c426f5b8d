"""ZJU-MoCap and HuMMan-Recon: peculiarities of their formats, on miniatures in their layouts."""

import pickle
import shutil
import sys
from pathlib import Path, PurePosixPath

import numpy as np
import pytest
from PIL import Image
from scipy import sparse

from ghgs_lit.data.humman import HuMMan
from ghgs_lit.data.pickles import load_npy
from ghgs_lit.data.reader import Photographs
from ghgs_lit.data.smpl import read_model
from ghgs_lit.data.view import half_centers
from ghgs_lit.data.zju_mocap import ZJUMoCap, frame_number, read_annotations
from ghgs_lit.errors import InputError
from ghgs_lit.geometry.undistortion import undistort, undistorting_grid
from scripts.miniatures.smpl import stand_in
from tests.helpers.captures import (
    build_data,
    inside,
    require_same_packed,
)

OPENCV = np.load(Path(__file__).parents[1] / "fixtures" / "opencv_camera.npz")
SIZE = 112
BOTH = ("mask_cihp", "mask")


def of_zju(root: Path, sequence: str = "386", frames=(0, 2, 1), size=None, **options) -> Photographs:
    split = {key: [{"sequences": [sequence], "frames": list(frames)}] for key in ("train", "val")}
    return Photographs(ZJUMoCap(root=root, split=split, **options).reader("val"), size)


def test_bodies_project_into_every_mask(zju_root):
    """Cameras, bodies and masks of both generations agree, after undistortion."""
    for sequence in ("386", "313"):
        data = of_zju(zju_root, sequence, cameras=None, masks=BOTH)
        shares = [
            inside(data.view(n, k), data.reader.read_checked_body(n))
            for n, ks in data.reader.subjects.items()
            for k in ks
        ]
        assert len(shares) == 2 * (21 if sequence == "313" else 23)
        assert min(shares) > 0.99


@pytest.mark.parametrize(("camera", "mode"), [(0, "L"), (3, "RGB")])
def test_any_label_is_the_performer(zju_root, camera, mode):
    """Label maps have many labels in one or three channels, and all except 0 are the performer."""
    path = zju_root / f"CoreView_386/mask_cihp/Camera_B{camera + 1}/000000.png"
    image = Image.open(path)
    labels = np.asarray(image).reshape(SIZE, SIZE, -1)[..., 0]
    assert image.mode == mode
    assert 0 < labels.max() < 20
    mask = of_zju(zju_root, undistorted=False).view("CoreView_386_000000", camera).mask
    np.testing.assert_array_equal(mask, labels > 0)


def test_masks_are_united(zju_root):
    """Masks of several folders are united."""
    parts = [of_zju(zju_root, undistorted=False, masks=[m]).view("CoreView_386_000000", 5).mask for m in BOTH]
    union = of_zju(zju_root, undistorted=False, masks=BOTH).view("CoreView_386_000000", 5).mask
    np.testing.assert_array_equal(union, parts[0] | parts[1])
    assert union.sum() > max(part.sum() for part in parts)


def test_a_sequence_without_the_second_folder_of_masks_is_read(zju_root, tmp_path):
    """A missing second folder of masks is not an error."""
    shutil.copytree(zju_root / "CoreView_386", tmp_path / "CoreView_386")
    shutil.rmtree(tmp_path / "CoreView_386" / "mask")
    one = of_zju(tmp_path, masks=BOTH).view("CoreView_386_000000", 0).mask
    np.testing.assert_array_equal(one, of_zju(zju_root).view("CoreView_386_000000", 0).mask)


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


def test_cameras_are_the_first_so_many(zju_root):
    """data.cameras is the number of cameras used, the first ones of a sequence."""
    assert of_zju(zju_root).reader.subjects["CoreView_386_000000"] == tuple(range(20))
    assert len(of_zju(zju_root, cameras=None).reader.subjects["CoreView_386_000000"]) == 23
    assert len(of_zju(zju_root, "313", cameras=None).reader.subjects["CoreView_313_000001"]) == 21


def test_old_sequences_count_frames_from_one(zju_root):
    """Sequences 313 and 315 number their frames from 1."""
    data = of_zju(zju_root, "313")
    assert list(data.reader.subjects) == ["CoreView_313_000001", "CoreView_313_000002"]
    assert not (zju_root / "CoreView_313" / "new_vertices" / "0.npy").exists()
    stored = np.load(zju_root / "CoreView_313" / "new_vertices" / "1.npy")
    np.testing.assert_array_equal(data.reader.read_checked_body("CoreView_313_000001"), stored)
    assert list(of_zju(zju_root).reader.subjects) == ["CoreView_386_000000", "CoreView_386_000001"]


@pytest.mark.parametrize("renamed", ["photographs", "masks", "both"])
def test_old_sequences_are_read_with_long_and_short_names(zju_root, tmp_path, renamed):
    """Files of 313 and 315 are found under their original and their short names."""
    shutil.copytree(zju_root / "CoreView_313", tmp_path / "CoreView_313")
    assert len(next((tmp_path / "CoreView_313").glob("Camera (22)/*.jpg")).stem.split("_")) == 7
    patterns = {"photographs": ["Camera*/*.jpg"], "masks": ["mask*/Camera*/*.png"]}
    for pattern in patterns.get(renamed, [*patterns["photographs"], *patterns["masks"]]):
        for path in (tmp_path / "CoreView_313").glob(pattern):
            path.rename(path.with_name(path.stem.split("_")[4] + path.suffix))
    one, other = (of_zju(place, "313").view("CoreView_313_000002", 19) for place in (zju_root, tmp_path))
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


def test_names_of_windows_are_read(zju_root, tmp_path):
    """Some published annotations use backslashes."""
    folder = tmp_path / "CoreView_386"
    shutil.copytree(zju_root / "CoreView_386", folder)
    content = load_npy(folder / "annots.npy")
    for frame in content["ims"]:
        frame["ims"] = [name.replace("/", "\\") for name in frame["ims"]]
    np.save(folder / "annots.npy", content)
    assert of_zju(tmp_path).view("CoreView_386_000000", 0).mask.any()


@pytest.mark.parametrize("shape", [(4,), (5,), (5, 1), (1, 5)])
def test_lens_coefficients_of_any_shape_are_read(zju_root, tmp_path, shape):
    """Coefficients are stored in several shapes."""
    folder = tmp_path / "CoreView_386"
    folder.mkdir()
    content = load_npy(zju_root / "CoreView_386" / "annots.npy")
    content["cams"]["D"] = [np.ravel(d)[: np.prod(shape)].reshape(shape) for d in content["cams"]["D"]]
    np.save(folder / "annots.npy", content)
    cameras, _ = read_annotations(folder / "annots.npy")
    assert len(cameras[0].distortion) == np.prod(shape)


def test_the_new_fit_is_preferred(zju_root, tmp_path):
    """The better fit is read where it exists, else the other, else none."""
    shutil.copytree(zju_root / "CoreView_386", tmp_path / "CoreView_386")
    new = np.load(zju_root / "CoreView_386" / "new_vertices" / "0.npy")
    old = np.load(zju_root / "CoreView_386" / "vertices" / "0.npy")
    assert new.shape == (6890, 3)
    assert np.abs(new - old).max() > 0.002
    np.testing.assert_array_equal(of_zju(zju_root).reader.read_checked_body("CoreView_386_000000"), new)
    shutil.rmtree(tmp_path / "CoreView_386" / "new_vertices")
    np.testing.assert_array_equal(of_zju(tmp_path).reader.read_checked_body("CoreView_386_000000"), old)
    shutil.rmtree(tmp_path / "CoreView_386" / "vertices")
    assert of_zju(tmp_path).reader.read_checked_body("CoreView_386_000000") is None


def test_frames_are_places_in_the_annotations(zju_root):
    """Frames are indices in annots.npy, not frame numbers; a start beyond the end raises."""
    assert list(of_zju(zju_root, frames=(1, 500, 5)).reader.subjects) == ["CoreView_386_000001"]
    assert list(of_zju(zju_root, frames=(0, 500, 5)).reader.subjects) == ["CoreView_386_000000"]
    with pytest.raises(InputError, match="expected a frame 700; found 2 frames"):
        of_zju(zju_root, frames=(700, 1000, 6))


def test_the_default_split_is_sherfs(zju_root):
    """The shipped configuration has SHERF's split, which the paper uses."""
    data = build_data("zju_mocap", zju_root).dataset
    train, val = data.split.train, data.split.val
    assert [s.sequences for s in train] == [("386", "387", "390", "392", "393", "394")]
    assert [s.sequences for s in val] == [("377", "313", "315")]
    assert len(range(*train[0].frames)) == 100
    assert list(range(*val[0].frames)) == list(range(0, 500, 20))


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


def test_other_protocols_are_configurations(zju_root):
    """Configurations of NHP and GP-NeRF have their numbers of frames and inputs."""
    nhp = build_data("zju_mocap_nhp", zju_root)
    assert (
        sum(len(range(*s.frames)) * len(s.sequences) for s in nhp.dataset.split.train)
        == 60 + 67 + 10 + 100 + 50 + 54
    )
    gp_nerf = build_data("zju_mocap_gp_nerf", zju_root)
    assert sum(len(range(*s.frames)) * len(s.sequences) for s in gp_nerf.dataset.split.train) == 1800
    assert gp_nerf.dataset.evaluation_positions == (
        (0, 8, 16),
        (0, 6, 12, 18),
        (0, 4, 8, 12, 16),
    )


def test_photographs_are_undistorted_about_their_own_pixel_centers(zju_root):
    """Calibrations have pixel centres at integers; an offset of half a pixel would undistort wrongly."""
    cameras, frames = read_annotations(zju_root / "CoreView_386" / "annots.npy")
    bent = of_zju(zju_root, undistorted=False).view("CoreView_386_000000", 7)
    path = zju_root / "CoreView_386" / frames[0][7]
    image = np.asarray(Image.open(path).convert("RGB"))
    lens = half_centers(cameras[7].intrinsics), cameras[7].distortion
    straight, matte = undistort(image, bent.mask * np.uint8(255), undistorting_grid(*lens, *image.shape[:2]))
    view = of_zju(zju_root).view("CoreView_386_000000", 7)
    np.testing.assert_array_equal(view.mask, matte > 127)
    np.testing.assert_array_equal(view.image, np.where(view.mask[..., None], straight, 0))


HUMMAN = "p000455_a000986"
WIDTH, HEIGHT = 160, 90


def of_humman(root: Path, size=None, **options) -> Photographs:
    data = HuMMan(root=root, split={"val": [HUMMAN]}, frames=(0, 97, 6), **options)
    return Photographs(data.reader("val"), size)


def test_frames_are_multiples_of_6_and_some_lack(humman_root):
    """Frames that a sequence lacks are skipped; all ten cameras are positions."""
    assert list(of_humman(humman_root).reader.subjects) == [f"{HUMMAN}_{n:06d}" for n in (0, 6, 18)]
    assert set(of_humman(humman_root).reader.subjects.values()) == {tuple(range(10))}


def test_a_camera_that_lacks_a_frame_is_left_out(humman_root, tmp_path):
    """A missing image removes one camera from its frame, not the whole frame."""
    shutil.copytree(humman_root / HUMMAN, tmp_path / HUMMAN)
    (tmp_path / HUMMAN / "kinect_color" / "kinect_004" / "000006.png").unlink()
    subjects = of_humman(tmp_path).reader.subjects
    assert subjects[f"{HUMMAN}_000006"] == (0, 1, 2, 3, 5, 6, 7, 8, 9)
    assert subjects[f"{HUMMAN}_000018"] == tuple(range(10))


def test_named_sequences_are_for_testing_and_the_rest_for_training(humman_root, tmp_path):
    """The official test sequences never reach training."""
    shutil.copytree(humman_root, tmp_path / "recon")
    (tmp_path / "recon" / "notes").mkdir()
    data = build_data("humman", tmp_path / "recon").dataset
    assert len(data.split.val) == len(set(data.split.val)) == 22
    assert data.sequences("train") == ["p100001_a000048"]
    assert {frame.folder.name for frame in data.reader("val").frames.values()} == {HUMMAN}
    assert list(range(*data.frames)) == [6 * i for i in range(17)]


def test_any_value_of_the_matting_is_the_performer(humman_root):
    """Low values of the matting are the performer, too."""
    path = humman_root / HUMMAN / "kinect_mask" / "kinect_002" / "000006.png"
    matting = np.asarray(Image.open(path))
    assert ((matting > 0) & (matting < 128)).any()
    np.testing.assert_array_equal(of_humman(humman_root).view(f"{HUMMAN}_000006", 2).mask, matting > 0)


def test_no_body_is_a_choice(humman_root):
    """Without a body model, ``body_vertices`` of batches is None, for training without the Chamfer loss."""
    assert of_humman(humman_root).reader.read_checked_body(f"{HUMMAN}_000000") is None
    batch = build_data("humman", humman_root, "data.size=[36,64]", "data.workers=0").training_batch(0)
    assert batch.body_vertices is None
    assert batch.images.shape == (1, 4, 3, 36, 64)


def test_evaluation_takes_evenly_spaced_inputs_and_all_other_targets(humman_root):
    """The documented protocol has inputs 0 3 6 and seven targets."""
    data = build_data("humman", humman_root, "data.size=[36,64]", "data.workers=0")
    samples = list(data.evaluation_loader(views=3))
    assert len(samples) == 3
    assert samples[0].views == (("000/0", "003/0", "006/0"),)
    targets, others = samples[0].targets, (1, 2, 4, 5, 7, 8, 9)
    assert targets.names == (tuple(f"{k:03}/0" for k in others),)
    views = [of_humman(humman_root, size=(36, 64)).view(f"{HUMMAN}_000000", k) for k in others]
    images = (255 * targets.images[0].movedim(1, -1)).round()
    np.testing.assert_array_equal(images, [view.image for view in views])
    np.testing.assert_array_equal(targets.cameras.extrinsics[0], [view.extrinsics for view in views])


def test_smpl_vertices_project_into_every_mask(humman_root):
    """Model, parameters and cameras are consistent."""
    pytest.importorskip("smplx")
    data = of_humman(humman_root, smpl_model=humman_root.with_name("recon_body_models"))
    for name in data.reader.subjects:
        assert data.reader.read_checked_body(name).shape == (6890, 3)
        assert min(inside(data.view(name, k), data.reader.read_checked_body(name)) for k in range(10)) > 0.97


def test_smpl_turns_about_the_pelvis_and_then_shifts(humman_root):
    """The body rotates about the pelvis before it is translated, as SMPL defines."""
    pytest.importorskip("smplx")
    from ghgs_lit.data.smpl import Body

    body, model = Body(humman_root.with_name("recon_body_models")), stand_in()
    still = {
        "betas": np.zeros(10),
        "body_pose": np.zeros(69),
        "global_orient": np.zeros(3),
        "transl": np.zeros(3),
    }
    rest = body.vertices(still)
    np.testing.assert_allclose(rest, model["v_template"], atol=1e-5)
    turned = body.vertices(
        {**still, "global_orient": np.array([0, np.pi, 0]), "transl": np.array([1.0, 2, 3])}
    )
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
    content = {
        **arrays,
        "shapedirs": Ch(arrays["shapedirs"]),
        "J_regressor": sparse.csc_matrix(arrays["J_regressor"]),
        "bs_type": "lrotmin",
    }
    path = tmp_path / "SMPL_NEUTRAL.pkl"
    path.write_bytes(pickle.dumps(content, protocol=protocol))
    monkeypatch.delitem(sys.modules, "chumpy.ch")
    read = read_model(path)
    for key, value in arrays.items():
        np.testing.assert_allclose(read[key], value)


def test_packed_frames_are_the_same(humman_root, tmp_path):
    require_same_packed(of_humman(humman_root).reader, tmp_path, (36, 64))
