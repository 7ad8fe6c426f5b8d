"""Files of cameras that other programs wrote, read back to the same projection."""

import json
from typing import get_args

import cv2
import numpy as np
import pycolmap
import pytest

from ghgs_capture.calibration import (
    Calibration,
    Convention,
    calibrate,
    extrinsics_of,
    quarter_turned,
)
from ghgs_capture.formats import FORMATS, read_cameras
from ghgs_capture.formats.json_and_toml import json_text
from ghgs_lit.config import nodes
from ghgs_lit.errors import InputError
from tests.helpers.rigs import POINTS, SIZE, opencv_pixels, rig
from tests.helpers.scenes import FIXTURES


def expected(camera) -> np.ndarray:
    """By OpenCV from the rig itself; centres at +0.5 as this package has them."""
    return opencv_pixels(POINTS, camera["R"], camera["T"], camera["K"], camera["D"]) + 0.5


def projected(calibration: Calibration, points=POINTS) -> np.ndarray:
    e = calibration.extrinsics
    return opencv_pixels(
        points, e[:3, :3], e[:3, 3], calibration.intrinsics, calibration.distortion, calibration.fisheye
    )


def check(path, format, points=POINTS, cameras=None, names=None):
    """Every camera of the file projects as the rig's does."""
    found, cameras = read_cameras(path), cameras or rig()
    assert found.format == format
    assert list(found.cameras) == (names or list(cameras))
    for stored, camera in zip(found.cameras.values(), cameras.values(), strict=True):
        error = np.abs(projected(calibrate(stored, found.convention, SIZE), points) - expected(camera)).max()
        assert error < 0.01


def write_yaml(path, fields):
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for key, value in fields.items():
        if isinstance(value, list):
            file.startWriteStruct(key, cv2.FILE_NODE_SEQ)
            for item in value:
                file.write("", item)
            file.endWriteStruct()
        else:
            file.write(key, value)
    file.release()


def test_opencv_writes_a_file_for_each_camera(tmp_path):
    for name, c in rig().items():
        pose = {"rvec": cv2.Rodrigues(c["R"])[0], "tvec": c["T"]}
        size = {"image_width": SIZE[1], "image_height": SIZE[0]}
        write_yaml(tmp_path / f"{name}.yml", {"camera_matrix": c["K"], "dist_coeffs": c["D"], **pose, **size})
    check(tmp_path, "opencv")
    assert read_cameras(tmp_path).cameras["cam_01"].size == SIZE


def test_opencv_writes_all_cameras_into_one_file(tmp_path):
    fields = {f"{key}_{name}": c[key] for name, c in rig().items() for key in "KDRT"}
    write_yaml(tmp_path / "rig.yaml", fields)
    check(tmp_path / "rig.yaml", "opencv")


@pytest.mark.parametrize("place", ["", "intri.yml", "extri.yml"])
def test_easymocap(tmp_path, place):
    """Both the rotation vector R and the matrix Rot are written; numbers are names, too."""
    cameras = {name.removeprefix("cam_"): c for name, c in rig().items()}
    intrinsics = {f"K_{n}": c["K"] for n, c in cameras.items()} | {
        f"dist_{n}": c["D"] for n, c in cameras.items()
    }
    write_yaml(tmp_path / "intri.yml", {"names": list(cameras), **intrinsics})
    poses = {f"R_{n}": cv2.Rodrigues(c["R"])[0] for n, c in cameras.items()}
    poses |= {f"Rot_{n}": c["R"] for n, c in cameras.items()} | {f"T_{n}": c["T"] for n, c in cameras.items()}
    write_yaml(tmp_path / "extri.yml", {"names": list(cameras), **poses})
    check(tmp_path / place, "easymocap", cameras=cameras)


COLMAP = {
    "SIMPLE_PINHOLE": [1000, 320, 427],
    "PINHOLE": [1000, 1010, 320, 427],
    "SIMPLE_RADIAL": [1000, 320, 427, 0.05],
    "RADIAL": [1000, 320, 427, 0.05, -0.02],
    "OPENCV": [1000, 1010, 320, 427, 0.05, -0.02, 0.002, -0.003],
    "FULL_OPENCV": [1000, 1010, 320, 427, 0.05, -0.02, 0.002, -0.003, 0.01, 0.02, -0.03, 0.01],
    "SIMPLE_RADIAL_FISHEYE": [1000, 320, 427, 0.05],
    "RADIAL_FISHEYE": [1000, 320, 427, 0.05, -0.02],
    "OPENCV_FISHEYE": [1000, 1010, 320, 427, 0.05, -0.02, 0.003, 0.004],
}


@pytest.mark.parametrize("binary", [True, False])
def test_colmap(tmp_path, binary):
    """Models as COLMAP itself writes them; its own projection is what counts."""
    model = pycolmap.Reconstruction()
    for i, ((kind, params), c) in enumerate(zip(COLMAP.items(), 3 * list(rig().values()), strict=False), 1):
        model.add_camera_with_trivial_rig(
            pycolmap.Camera(model=kind, width=SIZE[1], height=SIZE[0], params=params, camera_id=i)
        )
        pose = pycolmap.Rigid3d(np.column_stack((c["R"], c["T"])))
        model.add_image_with_trivial_frame(pycolmap.Image(name=f"{kind}.jpg", camera_id=i, image_id=i), pose)
    folder = tmp_path / "sparse" / "0"
    folder.mkdir(parents=True)
    (model.write_binary if binary else model.write_text)(str(folder))
    found = read_cameras(tmp_path)
    assert found.format == "colmap"
    assert set(found.cameras) == set(COLMAP)
    for image in model.images.values():
        local = image.cam_from_world() * POINTS
        pixels = np.stack([model.cameras[image.camera_id].img_from_cam(p) for p in local])
        calibration = calibrate(found.cameras[image.name.removesuffix(".jpg")], found.convention, SIZE)
        assert np.abs(projected(calibration) - pixels).max() < 0.01


def test_nerfstudio():
    """Converted from a COLMAP model by nerfstudio's own code,
    which turns the world and leaves out k3."""
    path = FIXTURES / "cameras" / "transforms.json"
    turn = np.array(json.loads(path.read_text())["applied_transform"])
    cameras = {name: c | {"D": c["D"][:4]} for name, c in rig().items()}
    check(path, "nerfstudio", POINTS @ turn[:, :3].T, cameras)


def test_nerfstudio_with_an_angle_of_view(tmp_path):
    """Instant NGP and Blender say the angle in place of the focal length,
    and nothing of the middle."""
    frame = {"file_path": "./train/r_0", "transform_matrix": np.eye(4).tolist()}
    content = {"camera_angle_x": 2 * np.arctan(0.4), "w": 800, "h": 600, "frames": [frame]}
    (tmp_path / "transforms_train.json").write_text(json.dumps(content))
    found = read_cameras(tmp_path / "transforms_train.json").cameras["r_0"]
    np.testing.assert_allclose(found.intrinsics, [[1000, 0, 400], [0, 1000, 300], [0, 0, 1]])


def test_anipose_and_pose2sim():
    check(FIXTURES / "cameras" / "anipose.toml", "toml")


def test_json_of_opencv_matrices(tmp_path):
    cameras = {name: {key: value.tolist() for key, value in c.items()} for name, c in rig().items()}
    (tmp_path / "cameras.json").write_text(json.dumps(cameras))
    check(tmp_path / "cameras.json", "opencv")
    (tmp_path / "cameras.json").write_text(json.dumps({"cameras": cameras, "units": "metre"}))
    with pytest.warns(UserWarning, match="entries that are not read: units"):
        check(tmp_path / "cameras.json", "opencv")


def test_own_json_comes_back(tmp_path):
    read = read_cameras(FIXTURES / "cameras" / "anipose.toml")
    calibrations = {n: (calibrate(c, read.convention, SIZE), SIZE) for n, c in read.cameras.items()}
    (tmp_path / "cameras.json").write_text(json_text(calibrations))
    check(tmp_path / "cameras.json", "ghgs")
    stored = json.loads((tmp_path / "cameras.json").read_text())["cameras"]
    assert {(camera["height"], camera["width"]) for camera in stored.values()} == {SIZE}


def test_a_photograph_of_another_size_scales_the_intrinsics():
    found = read_cameras(FIXTURES / "cameras" / "anipose.toml")
    half = calibrate(found.cameras["cam_02"], found.convention, (SIZE[0] // 2, SIZE[1] // 2))
    assert np.abs(projected(half) - expected(rig()["cam_02"]) / 2).max() < 0.01
    with pytest.raises(InputError, match=r"cam_02: expected a photograph of 854x640 .*found 640x854"):
        calibrate(found.cameras["cam_02"], found.convention, SIZE[::-1])


@pytest.mark.parametrize("turns", [1, 2, 3, 4, -1])
def test_a_turned_photograph_turns_its_camera(turns):
    """A spot of the photograph is where the turned camera says, after ``numpy.rot90``."""
    camera = rig()["cam_01"]
    pose = np.vstack((np.column_stack((camera["R"], camera["T"])), [0, 0, 0, 1]))
    straight = Calibration(camera["K"] + [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]], pose, np.zeros(0), False)
    for point in POINTS[:4]:
        column, row = np.floor(projected(straight, point[None])[0]).astype(int)
        spot = np.zeros(SIZE, bool)
        spot[row, column] = True
        [[turned_row, turned_column]] = np.argwhere(np.rot90(spot, turns))
        pixel = projected(quarter_turned(straight, turns, SIZE), point[None])[0]
        assert np.abs(pixel - [turned_column + 0.5, turned_row + 0.5]).max() <= 0.5 + 1e-9


def test_a_frames_own_intrinsics_win_over_those_of_the_file(tmp_path):
    """Of nerfstudio, where cameras differ: each number by itself."""
    frame = {"transform_matrix": np.eye(4).tolist()}
    frames = [{**frame, "file_path": "a.png"}, {**frame, "file_path": "b.png", "fl_x": 500, "cy": 90}]
    shared = {"fl_x": 1000, "fl_y": 900, "cx": 100, "cy": 80, "w": 200, "h": 160}
    (tmp_path / "transforms.json").write_text(json.dumps({**shared, "frames": frames}))
    cameras = read_cameras(tmp_path / "transforms.json").cameras
    np.testing.assert_array_equal(cameras["a"].intrinsics, [[1000, 0, 100], [0, 900, 80], [0, 0, 1]])
    np.testing.assert_array_equal(cameras["b"].intrinsics, [[500, 0, 100], [0, 900, 90], [0, 0, 1]])


@pytest.mark.parametrize("extrinsics", ["world_to_camera", "camera_to_world"])
def test_a_unit_is_metres_of_one_unit_of_length(extrinsics):
    """A rig in millimetres: cameras stand a thousandth as far away."""
    camera = rig()["cam_01"]
    pose = np.vstack((np.column_stack((camera["R"], camera["T"])), [0, 0, 0, 1]))
    metres, millimetres = (
        extrinsics_of(pose, Convention(extrinsics=extrinsics, unit=unit)) for unit in (1.0, 0.001)
    )
    np.testing.assert_allclose(millimetres[:3, 3], metres[:3, 3] / 1000)
    np.testing.assert_array_equal(millimetres[:3, :3], metres[:3, :3])


@pytest.mark.parametrize("extrinsics", ["world_to_camera", "camera_to_world"])
def test_rotations_of_seven_digits_far_away(extrinsics):
    """The centre was 9 mm from where the camera projects from,
    and an image changed by up to 0.02."""
    rotation, center = rig()["cam_01"]["R"].round(7), np.array([1e5, -3e4, 1e4])
    pose, around = np.eye(4), center + POINTS
    pose[:3, :3] = rotation if extrinsics == "world_to_camera" else rotation.T
    pose[:3, 3] = -rotation @ center if extrinsics == "world_to_camera" else center
    found = extrinsics_of(pose, Convention(extrinsics=extrinsics))
    assert np.abs(found[:3, :3] @ found[:3, :3].T - np.eye(3)).max() < 1e-12
    assert np.abs(-found[:3, :3].T @ found[:3, 3] - center).max() < 1e-6
    local = around @ found[:3, :3].T + found[:3, 3]
    assert np.abs(local - POINTS @ rotation.T).max() < 1e-5


def test_every_format_can_be_said():
    assert get_args(nodes.Calibration.model_fields["format"].annotation) == ("auto", *FORMATS)
