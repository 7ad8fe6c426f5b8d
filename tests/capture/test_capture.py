"""From files to a model's batch, and back to the user's world."""

import cv2
import numpy as np
import pytest
import torch
from PIL import Image
from scipy.ndimage import gaussian_filter

from ghgs_capture import Capture, predict
from ghgs_capture.folder import CaptureFolder
from ghgs_lit.execution import Predictor
from ghgs_lit.geometry.projection import project
from ghgs_lit.geometry.undistortion import undistorting_grid
from ghgs_lit.refinement import Refinement
from ghgs_lit.rendering import Renderer
from tests.helpers.figures import PARTS, Figure, camera_as_stored, write_turned
from tests.helpers.models import make_model
from tests.helpers.rigs import SIZE, opencv_pixels, rig

HEAD = torch.tensor([PARTS[1][0]], dtype=torch.float64)


def pixel_of(photograph, point=HEAD):
    k, e = torch.from_numpy(photograph.intrinsics)[None], torch.from_numpy(photograph.extrinsics)[None]
    return project(point, k, e)[0][0].numpy()


def test_crops_hold_the_subject_and_their_cameras_follow(tmp_path):
    """A point projects to the same position on the subject before and after the crop."""
    figure = Figure(height=160, width=120)
    capture = Capture.read(tmp_path, figure.write(tmp_path))
    batch = capture.batch((84, 56))
    assert batch.images.shape == (1, 4, 3, 84, 56)
    assert (batch.images[0].movedim(1, -1)[batch.alpha[0] == 0] == 0).all()
    for v, photograph in enumerate(capture.photographs):
        mask = batch.masks[0, v].numpy()
        extents = [np.ptp(np.nonzero(mask.any(axis))[0]) + 1 for axis in (1, 0)]
        assert 0.75 <= max(extents[0] / 84, extents[1] / 56) <= 0.85
        before = np.argwhere(photograph.mask)[:, ::-1] + 0.5
        after = np.argwhere(mask)[:, ::-1] + 0.5
        place = (pixel_of(photograph) - before.min(0)) / np.ptp(before, axis=0)
        camera = batch.cameras[0, v]
        pixel = project(HEAD, camera.intrinsics[None], camera.extrinsics[None])[0][0].numpy()
        assert np.abs(place - (pixel - after.min(0)) / np.ptp(after, axis=0)).max() < 0.04


def test_a_subject_cut_by_the_border_is_cut_in_the_crop(tmp_path):
    """Black beyond the border would look like the end of the subject."""
    figure = Figure()
    figure.images, figure.masks = figure.images[:, :90], figure.masks[:, :90]
    for camera in figure.cameras.values():
        camera["height"] = 90
    batch = Capture.read(tmp_path, figure.write(tmp_path)).batch((84, 84))
    assert batch.masks[0, :, -1].any(-1).all()


@pytest.mark.parametrize(
    ("scale", "origin"), [(0.11, (0, 0, 0)), (110.0, (3e3, -2e3, 5e3)), (1.0, (4e5, 5e6, 100))]
)
def test_figurines_and_statues_are_predicted_alike(tmp_path, scale, origin):
    """The same photographs in another unit and origin yield the same Gaussians there."""
    model = Predictor(make_model("model=hull").eval())
    first = Capture.read(tmp_path / "a", Figure().write(tmp_path / "a"))
    other = Capture.read(tmp_path / "b", Figure(scale=scale, origin=origin).write(tmp_path / "b"))
    person, moved = (predict(capture, model, 56) for capture in (first, other))
    assert float(moved.gaussians.metre) == pytest.approx(scale * float(person.gaussians.metre), rel=1e-5)
    expected = person.gaussians.means.double() * scale + torch.tensor(origin).double()
    error = (moved.gaussians.means.double() - expected).norm(dim=-1).median() / scale
    assert error < 1e-5
    ratio = (moved.gaussians.scales / scale / person.gaussians.scales).median()
    assert ratio == pytest.approx(1, abs=0.05)
    camera = moved.batch.cameras[0, 0]
    assert camera.centers.double().numpy() == pytest.approx(
        _center(other.photographs[0]), rel=1e-4, abs=1e-3 * scale
    )


def test_python_refines_as_the_command_line_does(tmp_path):
    capture = Capture.read(tmp_path, Figure().write(tmp_path))
    model = Predictor(make_model("model=hull").eval())
    plain, refined = (predict(capture, model, 28, refine=steps) for steps in (0, 2))
    expected = Refinement(2, Renderer())(plain.gaussians, plain.batch)
    assert torch.equal(refined.gaussians.means, expected.means)


def _center(photograph):
    return -photograph.extrinsics[:3, :3].T @ photograph.extrinsics[:3, 3]


@pytest.mark.parametrize("orientation", [3, 6, 8])
@pytest.mark.parametrize("calibrated", ["shown", "stored"])
def test_exif_turns_do_not_move_the_subject(tmp_path, orientation, calibrated):
    """Phones store pixels in the sensor's orientation; calibrations are for these or for the rotated ones."""
    figure = Figure()
    path = figure.write(tmp_path)
    right = Capture.read(tmp_path, path)
    for name, image in zip(figure.names, figure.images, strict=True):
        write_turned(tmp_path / f"{name}.png", image, orientation)
    options = {}
    if calibrated == "stored":
        cameras = {n: camera_as_stored(c, orientation) for n, c in figure.cameras.items()}
        figure.names = []
        figure.write(tmp_path, cameras=cameras)
        options = {"calibration": {"exif": "stored"}} if orientation == 3 else {}
    for one, other in zip(
        right.photographs, Capture.read(tmp_path, path, **options).photographs, strict=True
    ):
        np.testing.assert_array_equal(one.image, other.image)
        np.testing.assert_array_equal(one.mask, other.mask)
        np.testing.assert_allclose(pixel_of(one), pixel_of(other), atol=1e-9)


NOISE = np.random.default_rng(1).integers(-3, 4, (128, 96, 3))
# The folder and the picture from photograph, mask and background; the option that names the folder.
SOURCES = {
    "alpha": ("images", lambda image, mask, _: np.dstack((image, mask * 255)), None),
    "folder": ("masks", lambda _, mask, __: mask * 255, "masks"),
    "labels": ("masks", lambda _, mask, __: mask * 7, "masks"),
    "backgrounds": ("empty", lambda _, __, background: background + NOISE, "backgrounds"),
}


@pytest.mark.parametrize("source", SOURCES)
def test_masks_come_from_many_places(tmp_path, source):
    figure = Figure()
    path = figure.write(tmp_path / "images", masks=False)
    place, picture, option = SOURCES[source]
    (tmp_path / place).mkdir(exist_ok=True)
    for name, *parts in zip(figure.names, figure.images, figure.masks, figure.backgrounds, strict=True):
        Image.fromarray(picture(*parts).astype(np.uint8)).save(tmp_path / place / f"{name}.png")
    options = {option: tmp_path / place} if option else {}
    found = np.stack([p.mask for p in Capture.read(tmp_path / "images", path, **options).photographs])
    least = 0.9 if source == "backgrounds" else 1.0
    assert (found & figure.masks).sum() / (found | figure.masks).sum() >= least


def test_soft_masks_are_mattes(tmp_path):
    """Grey values of a mask are coverage; the background does not contribute to the rim in model inputs."""
    figure = Figure()
    path = figure.write(tmp_path)
    sharp = Capture.read(tmp_path, path).batch((42, 42))
    assert ((sharp.alpha > 0.1) & (sharp.alpha < 0.9)).sum() > 100  # of a larger photograph's mask
    assert torch.equal(sharp.masks, sharp.alpha > 127.5 / 255)
    for name, image, mask in zip(figure.names, figure.images, figure.masks, strict=True):
        matte = gaussian_filter(mask * 255.0, 1.5).round().astype(np.uint8)
        Image.fromarray(matte).save(tmp_path / f"{name}_mask.png")
        Image.fromarray(np.where(mask[..., None], image, 255).astype(np.uint8)).save(tmp_path / f"{name}.png")
    capture = Capture.read(tmp_path, path)
    np.testing.assert_array_equal(capture.photographs[-1].matte, matte)
    soft = capture.batch((42, 42))
    assert (soft.images <= soft.alpha[:, :, None] + 2 / 255).all()  # premultiplied
    assert ((soft.alpha > 0) & (soft.alpha < 1)).sum() > ((sharp.alpha > 0) & (sharp.alpha < 1)).sum()


@pytest.mark.parametrize("fisheye", [False, True])
def test_undistorted_photographs_are_pinhole_photographs(fisheye):
    """The grid samples a pixel where OpenCV's lens model projects its ray."""
    camera = rig()["cam_01"]
    distortion = np.array([0.05, -0.02, 0.003, 0.004]) if fisheye else camera["D"] * 5
    k = camera["K"] + [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]
    height, width = SIZE
    grid = undistorting_grid(k, distortion, height, width, fisheye)[0].double().numpy()
    rows, columns = np.indices(SIZE)[:, ::61, ::47].reshape(2, -1)
    rays = np.stack((columns + 0.5, rows + 0.5, np.ones(len(rows))), -1) @ np.linalg.inv(k).T
    places = opencv_pixels(rays, np.eye(3), np.zeros(3), k, distortion, fisheye)
    ours = (grid[rows, columns] + 1) / 2 * [width, height]
    assert np.abs(ours - places).max() < 0.02


@pytest.mark.parametrize(
    ("lens", "fisheye", "turn"),
    [
        ([0.02, -0.05, 0, 0, -6], False, 0.5361),  # 1 + 3 k1 r^2 + 5 k2 r^4 + 7 k3 r^6 = 0
        ([-0.1, 0, 0, 0], False, (1 / 0.3) ** 0.5),
        ([-1.0, 0, 0, 0], True, np.tan((1 / 3) ** 0.5)),
        ([0.1, 0.01, 0, 0, 0.001], False, None),
    ],
)
def test_a_lens_is_not_read_beyond_where_its_model_turns_back(lens, fisheye, turn):
    matrix = np.array([[50.0, 0, 50], [0, 50, 40], [0, 0, 1]])
    grid = undistorting_grid(matrix, np.array(lens), 300, 300, fisheye)[0]
    rows, columns = np.meshgrid(np.arange(300) + 0.5, np.arange(300) + 0.5, indexing="ij")
    radii = np.hypot((columns - 50) / 50, (rows - 40) / 50)
    is_read = ~(grid == 4).all(-1).numpy()
    if turn is None:
        assert is_read.all()
    else:
        assert is_read[radii < turn - 0.01].all()
        assert not is_read[radii > turn + 0.01].any()


def test_a_bent_photograph_is_straightened(tmp_path):
    """OpenCV distorts photographs of a pinhole camera; reading undoes it."""
    figure = Figure()
    distortion = [-0.2, 0.05, 0.002, -0.001, 0.0]
    straight = Capture.read(tmp_path, figure.write(tmp_path))
    for v, (name, camera) in enumerate(figure.cameras.items()):
        k = np.array(camera["intrinsics"]) - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]
        rows, columns = np.indices(figure.masks[v].shape).astype(np.float64)
        bent = np.stack((columns, rows), -1).reshape(-1, 1, 2)
        source = cv2.undistortPoints(bent, k, np.array(distortion), P=k).reshape(*rows.shape, 2)
        image, mask = (
            cv2.remap(
                a, source[..., 0].astype(np.float32), source[..., 1].astype(np.float32), cv2.INTER_LINEAR
            )
            for a in (figure.images[v], figure.masks[v].astype(np.uint8) * 255)
        )
        Image.fromarray(image).save(tmp_path / f"{name}.png")
        Image.fromarray(mask).save(tmp_path / f"{name}_mask.png")
        camera["distortion"] = distortion
    figure.names = []
    bent = CaptureFolder(tmp_path, figure.write(tmp_path)).photographs(tmp_path.name)
    for one, other in zip(straight.photographs, bent, strict=True):
        assert (one.mask ^ other.mask).sum() < 0.08 * one.mask.sum()
        crossed = np.array(Image.open(tmp_path / f"{one.name}_mask.png")) > 127
        assert (one.mask ^ other.mask).sum() < 0.5 * (one.mask ^ crossed).sum()
