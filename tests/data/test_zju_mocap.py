"""ZJU-MoCap: every oddity of the format, on a miniature in its true layout."""

import shutil
from pathlib import Path, PurePosixPath

import numpy as np
import pytest
from PIL import Image

from ghgs_lit.data.pickles import load_npy
from ghgs_lit.data.reader import Photographs
from ghgs_lit.data.view import half_centers
from ghgs_lit.data.zju_mocap import ZJUMoCap, frame_number, read_annotations
from ghgs_lit.errors import InputError
from ghgs_lit.geometry.undistortion import undistort, undistorting_grid
from tests.helpers.captures import (
    build_data,
    inside,
)

OPENCV = np.load(Path(__file__).parents[1] / "fixtures" / "opencv_camera.npz")
SIZE = 112
BOTH = ("mask_cihp", "mask")


def photographs(root: Path, sequence: str = "386", frames=(0, 2, 1), size=None, **options) -> Photographs:
    split = {key: [{"sequences": [sequence], "frames": list(frames)}] for key in ("train", "val")}
    return Photographs(ZJUMoCap(root=root, split=split, **options).reader("val"), size)


def test_bodies_project_into_every_mask(zju_root):
    """Cameras, bodies and masks of both generations agree, after undistortion."""
    for sequence in ("386", "313"):
        data = photographs(zju_root, sequence, cameras=None, masks=BOTH)
        shares = [inside(data.view(n, k), data.body(n)) for n, ks in data.reader.subjects.items() for k in ks]
        assert len(shares) == 2 * (21 if sequence == "313" else 23)
        assert min(shares) > 0.99


@pytest.mark.parametrize(("camera", "mode"), [(0, "L"), (3, "RGB")])
def test_any_label_is_the_performer(zju_root, camera, mode):
    """Label maps have many labels, in one channel or three; any but 0 is the performer."""
    path = zju_root / f"CoreView_386/mask_cihp/Camera_B{camera + 1}/000000.png"
    image = Image.open(path)
    labels = np.asarray(image).reshape(SIZE, SIZE, -1)[..., 0]
    assert image.mode == mode
    assert 0 < labels.max() < 20
    mask = photographs(zju_root, undistorted=False).view("CoreView_386_000000", camera).mask
    np.testing.assert_array_equal(mask, labels > 0)


def test_masks_are_united(zju_root):
    """Several folders of masks give their union."""
    parts = [
        photographs(zju_root, undistorted=False, masks=[m]).view("CoreView_386_000000", 5).mask for m in BOTH
    ]
    union = photographs(zju_root, undistorted=False, masks=BOTH).view("CoreView_386_000000", 5).mask
    np.testing.assert_array_equal(union, parts[0] | parts[1])
    assert union.sum() > max(part.sum() for part in parts)


def test_a_sequence_without_the_second_folder_of_masks_is_read(zju_root, tmp_path):
    """A missing second folder of masks is not an error."""
    shutil.copytree(zju_root / "CoreView_386", tmp_path / "CoreView_386")
    shutil.rmtree(tmp_path / "CoreView_386" / "mask")
    one = photographs(tmp_path, masks=BOTH).view("CoreView_386_000000", 0).mask
    np.testing.assert_array_equal(one, photographs(zju_root).view("CoreView_386_000000", 0).mask)


def test_undistortion_is_that_of_opencv():
    """The published calibrations are OpenCV's;
    our undistortion agrees with stored results of it."""
    height, width = OPENCV["image"].shape[:2]
    grid = undistorting_grid(half_centers(OPENCV["intrinsics"]), OPENCV["distortion"].ravel(), height, width)
    image, mask = undistort(OPENCV["image"], np.full((height, width), 255, np.uint8), grid)
    error = np.abs(image.astype(int) - OPENCV["undistorted"])
    assert error.mean() < 0.3
    assert error.max() <= 4  # OpenCV rounds places to 1/32 px
    assert np.abs(OPENCV["image"].astype(int) - OPENCV["undistorted"]).mean() > 20
    assert mask.min() == 0


def test_cameras_are_the_first_so_many(zju_root):
    """data.cameras selects the first cameras of a sequence."""
    assert photographs(zju_root).reader.subjects["CoreView_386_000000"] == tuple(range(20))
    assert len(photographs(zju_root, cameras=None).reader.subjects["CoreView_386_000000"]) == 23
    assert len(photographs(zju_root, "313", cameras=None).reader.subjects["CoreView_313_000001"]) == 21


def test_old_sequences_count_frames_from_one(zju_root):
    """313 and 315 number their frames from 1, and have 21 cameras."""
    data = photographs(zju_root, "313")
    assert list(data.reader.subjects) == ["CoreView_313_000001", "CoreView_313_000002"]
    assert not (zju_root / "CoreView_313" / "new_vertices" / "0.npy").exists()
    stored = np.load(zju_root / "CoreView_313" / "new_vertices" / "1.npy")
    np.testing.assert_array_equal(data.body("CoreView_313_000001"), stored)
    assert list(photographs(zju_root).reader.subjects) == ["CoreView_386_000000", "CoreView_386_000001"]


@pytest.mark.parametrize("renamed", ["photographs", "masks", "both"])
def test_old_sequences_are_read_with_long_and_short_names(zju_root, tmp_path, renamed):
    """Renamed files of 313 and 315 are found, too."""
    shutil.copytree(zju_root / "CoreView_313", tmp_path / "CoreView_313")
    assert len(next((tmp_path / "CoreView_313").glob("Camera (22)/*.jpg")).stem.split("_")) == 7
    patterns = {"photographs": ["Camera*/*.jpg"], "masks": ["mask*/Camera*/*.png"]}
    for pattern in patterns.get(renamed, [*patterns["photographs"], *patterns["masks"]]):
        for path in (tmp_path / "CoreView_313").glob(pattern):
            path.rename(path.with_name(path.stem.split("_")[4] + path.suffix))
    one, other = (photographs(place, "313").view("CoreView_313_000002", 19) for place in (zju_root, tmp_path))
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
    assert photographs(tmp_path).view("CoreView_386_000000", 0).mask.any()


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
    np.testing.assert_array_equal(photographs(zju_root).body("CoreView_386_000000"), new)
    shutil.rmtree(tmp_path / "CoreView_386" / "new_vertices")
    np.testing.assert_array_equal(photographs(tmp_path).body("CoreView_386_000000"), old)
    shutil.rmtree(tmp_path / "CoreView_386" / "vertices")
    assert photographs(tmp_path).body("CoreView_386_000000") is None


def test_frames_are_places_in_the_annotations(zju_root):
    """Frames are indices, not frame numbers; an impossible start is refused."""
    assert list(photographs(zju_root, frames=(1, 500, 5)).reader.subjects) == ["CoreView_386_000001"]
    assert list(photographs(zju_root, frames=(0, 500, 5)).reader.subjects) == ["CoreView_386_000000"]
    with pytest.raises(InputError, match="expected a frame 700; found 2 frames"):
        photographs(zju_root, frames=(700, 1000, 6))


def test_the_default_split_is_sherfs(zju_root):
    """The split that the paper follows, in the shipped configuration."""
    data = build_data("zju_mocap", zju_root).dataset
    train, val = data.split.train, data.split.val
    assert [s.sequences for s in train] == [("386", "387", "390", "392", "393", "394")]
    assert [s.sequences for s in val] == [("377", "313", "315")]
    assert len(range(*train[0].frames)) == 100
    assert list(range(*val[0].frames)) == list(range(0, 500, 20))
    assert data.published == {"train": 6, "val": 3}


def test_batches_have_the_protocols_cameras(zju_root):
    """Inputs 0 7 15 and all 17 other cameras as targets; frames are not people."""
    data = build_data("zju_mocap", zju_root, "data.size=64", "data.workers=0", "views=v3")
    batch = data.training_batch(0)
    assert batch.images.shape == (1, 3, 3, 64, 64)
    assert batch.targets.images.shape == (1, 1, 3, 64, 64)
    assert batch.body_vertices[0].shape == (6890, 3)
    assert [data.dataset.reader(phase).people for phase in ("train", "val")] == [1, 1]
    samples = list(data.evaluation_loader(views=3))
    assert samples[0].views == (("000/0", "007/0", "015/0"),)
    assert [len(names) for sample in samples for names in sample.targets.names] == [17]


def test_other_protocols_are_configurations(zju_root):
    """NHP's and GP-NeRF's numbers of frames and inputs."""
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
    """Calibrations count centres from integers;
    half a pixel would bend the photograph elsewhere."""
    cameras, frames = read_annotations(zju_root / "CoreView_386" / "annots.npy")
    bent = photographs(zju_root, undistorted=False).view("CoreView_386_000000", 7)
    path = zju_root / "CoreView_386" / frames[0][7]
    image = np.asarray(Image.open(path).convert("RGB"))
    lens = half_centers(cameras[7].intrinsics), cameras[7].distortion
    straight, matte = undistort(image, bent.mask * np.uint8(255), undistorting_grid(*lens, *image.shape[:2]))
    view = photographs(zju_root).view("CoreView_386_000000", 7)
    np.testing.assert_array_equal(view.mask, matte > 127)
    np.testing.assert_array_equal(view.image, np.where(view.mask[..., None], straight, 0))
