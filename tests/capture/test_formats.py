"""Camera files written by other programs are read to the same projection."""

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
    quarter_turn,
)
from ghgs_capture.formats import FORMATS, read_cameras
from ghgs_capture.formats.matrices import camera_entry, cameras_json
from ghgs_lit.config import nodes
from ghgs_lit.errors import InputError
from tests.helpers.calibrations import CAMERA, frame, one_camera, transforms, write
from tests.helpers.rigs import POINTS, SIZE, opencv_pixels, rig
from tests.helpers.scenes import FIXTURES

ANIPOSE = FIXTURES / "cameras" / "anipose.toml"


def expected(camera) -> np.ndarray:
    """Projections by OpenCV from the rig, with pixel centres at +0.5."""
    return opencv_pixels(POINTS, camera["R"], camera["T"], camera["K"], camera["D"]) + 0.5


def projected(calibration: Calibration, points=POINTS) -> np.ndarray:
    e = calibration.extrinsics
    lens = calibration.intrinsics, calibration.distortion, calibration.fisheye
    return opencv_pixels(points, e[:3, :3], e[:3, 3], *lens)


def check(path, points=POINTS, cameras=None):
    """Check that every camera of a file projects like the rig's."""
    found, cameras = read_cameras(path), cameras or rig()
    assert list(found.cameras) == list(cameras)
    for stored, camera in zip(found.cameras.values(), cameras.values(), strict=True):
        error = np.abs(projected(calibrate(stored, found.convention, SIZE), points) - expected(camera)).max()
        assert error < 0.01
        assert stored.size in (None, SIZE)


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
    return path


def lists():
    return {name: {key: value.tolist() for key, value in c.items()} for name, c in rig().items()}


def a_file_for_each_camera(path):
    for name, c in rig().items():
        pose = {"rvec": cv2.Rodrigues(c["R"])[0], "tvec": c["T"]}
        size = {"image_width": SIZE[1], "image_height": SIZE[0]}
        write_yaml(path / f"{name}.yml", {"camera_matrix": c["K"], "dist_coeffs": c["D"], **pose, **size})
    return path


def all_in_one_file(path):
    return write_yaml(path / "rig.yaml", {f"{k}_{name}": c[k] for name, c in rig().items() for k in "KDRT"})


def own_json(path):
    read = read_cameras(ANIPOSE)
    entries = {}
    for name, stored in read.cameras.items():
        camera = calibrate(stored, read.convention, SIZE)
        entries[name] = camera_entry(camera.intrinsics, camera.extrinsics, SIZE)
        entries[name] |= {"distortion": camera.distortion.tolist(), "fisheye": camera.fisheye}
    return write(path / "cameras.json", cameras_json(entries))


WRITERS = {
    "opencv, a file each": a_file_for_each_camera,
    "opencv, one file": all_in_one_file,
    "opencv, JSON": lambda path: write(path / "cameras.json", lists()),
    "anipose and pose2sim": lambda path: ANIPOSE,
    "own": own_json,
}


@pytest.mark.parametrize("name", WRITERS)
def test_files_of_programs(tmp_path, name):
    check(WRITERS[name](tmp_path))


@pytest.mark.parametrize("place", ["", "intri.yml", "extri.yml"])
def test_easymocap(tmp_path, place):
    """Both the rotation vector R and the matrix Rot are written; numbers are valid names."""
    cameras = {name.removeprefix("cam_"): c for name, c in rig().items()}
    lens, poses = {"names": list(cameras)}, {"names": list(cameras)}
    for n, c in cameras.items():
        lens |= {f"K_{n}": c["K"], f"dist_{n}": c["D"]}
        poses |= {f"R_{n}": cv2.Rodrigues(c["R"])[0], f"Rot_{n}": c["R"], f"T_{n}": c["T"]}
    write_yaml(tmp_path / "intri.yml", lens)
    write_yaml(tmp_path / "extri.yml", poses)
    check(tmp_path / place, cameras=cameras)


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
    """Models written by COLMAP itself, compared with its own projection."""
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
    assert set(found.cameras) == set(COLMAP)
    for image in model.images.values():
        local = image.cam_from_world() * POINTS
        pixels = np.stack([model.cameras[image.camera_id].img_from_cam(p) for p in local])
        calibration = calibrate(found.cameras[image.name.removesuffix(".jpg")], found.convention, SIZE)
        assert np.abs(projected(calibration) - pixels).max() < 0.01


def test_nerfstudio():
    """Converted from a COLMAP model by nerfstudio's own code, which rotates the world and omits k3."""
    path = FIXTURES / "cameras" / "transforms.json"
    turn = np.array(json.loads(path.read_text())["applied_transform"])
    cameras = {name: c | {"D": c["D"][:4]} for name, c in rig().items()}
    check(path, POINTS @ turn[:, :3].T, cameras)


FRAMES = [frame("a.png"), frame("b.png", fl_x=500, cy=90)]
SHARED = {"fl_x": 1000, "fl_y": 900, "cx": 100, "cy": 80, "w": 200, "h": 160, "frames": FRAMES}
ANGLE = {"camera_angle_x": 2 * np.arctan(0.4), "w": 800, "h": 600, "frames": [frame("./train/r_0")]}


@pytest.mark.parametrize(
    ("content", "name", "intrinsics"),
    [
        (SHARED, "a", [[1000, 0, 100], [0, 900, 80], [0, 0, 1]]),
        (SHARED, "b", [[500, 0, 100], [0, 900, 90], [0, 0, 1]]),  # a frame's own numbers win
        (ANGLE, "r_0", [[1000, 0, 400], [0, 1000, 300], [0, 0, 1]]),  # Instant NGP and Blender
    ],
)
def test_intrinsics_of_nerfstudio(tmp_path, content, name, intrinsics):
    cameras = read_cameras(write(tmp_path / "transforms_train.json", content)).cameras
    np.testing.assert_allclose(cameras[name].intrinsics, intrinsics)


def test_an_angle_of_view_alone_is_of_the_photograph(tmp_path):
    """Files of NeRF and Blender have no size: that of the photographs is used, before and after a quarter
    turn."""
    poses = rig()
    angle, frames = 2 * np.arctan(0.5), []
    for name, camera in poses.items():
        pose = np.eye(4)
        pose[:3, :3] = camera["R"].T @ np.diag([1, -1, -1])
        pose[:3, 3] = -camera["R"].T @ camera["T"]
        frames.append(frame(f"./train\\{name}", transform_matrix=pose.tolist()))
    path = tmp_path / "transforms.json"
    file = read_cameras(write(path, {"camera_angle_x": angle, "frames": frames}))
    assert list(file.cameras) == list(poses)
    stored = file.cameras["cam_01"]
    for height, width in (SIZE, SIZE[::-1]):
        found = calibrate(stored, file.convention, (height, width))
        np.testing.assert_allclose(
            found.intrinsics, [[width, 0, width / 2], [0, width, height / 2], [0, 0, 1]], rtol=1e-12
        )
        np.testing.assert_allclose(found.extrinsics[:3, :3], poses["cam_01"]["R"], atol=1e-12)
    assert not stored.has_numbers_of(read_cameras(transforms(tmp_path, frame("cam_01"))).cameras["cam_01"])
    vertical = read_cameras(write(path, {"camera_angle_y": angle, "frames": frames})).cameras["cam_01"]
    assert calibrate(vertical, file.convention, SIZE).intrinsics[0, 0] == pytest.approx(SIZE[0])
    for wrong, line in (
        ({"camera_angle_x": 0}, "camera_angle_x: expected radians between 0 and pi"),
        ({"camera_angle_x": 4}, "camera_angle_x: expected radians between 0 and pi"),
        ({"camera_angle_x": "wide"}, "camera_angle_x: expected a finite"),
        ({"cx": 3}, r"frames\[0\]: expected fl_x or camera_angle_x; found"),
    ):
        with pytest.raises(InputError, match=line):
            read_cameras(write(path, {**wrong, "frames": frames}))


def test_a_photograph_of_another_size_scales_the_intrinsics(tmp_path):
    found = read_cameras(ANIPOSE)
    half = calibrate(found.cameras["cam_02"], found.convention, (SIZE[0] // 2, SIZE[1] // 2))
    assert np.abs(projected(half) - expected(rig()["cam_02"]) / 2).max() < 0.01
    with pytest.raises(InputError, match=r"cam_02: expected a photograph of 854x640 .*found 640x854"):
        calibrate(found.cameras["cam_02"], found.convention, SIZE[::-1])
    # Video of 1080 pixels of a sensor of 1088.
    camera = one_camera(tmp_path, width=1088, height=1920)
    assert calibrate(camera, found.convention, (960, 540)).intrinsics[0, 0] == pytest.approx(500)
    with pytest.raises(InputError, match="expected a photograph of 1920x1088"):
        calibrate(camera, found.convention, (960, 500))


def pose_of(camera):
    return np.vstack((np.column_stack((camera["R"], camera["T"])), [0, 0, 0, 1]))


@pytest.mark.parametrize("turns", [1, 2, 3, 4, -1])
def test_a_turned_photograph_turns_its_camera(turns):
    """After ``numpy.rot90``, a point of the photograph lies where the rotated camera projects it."""
    camera = rig()["cam_01"]
    lens = camera["K"] + [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]
    straight = Calibration(lens, pose_of(camera), np.zeros(0), False)
    for point in POINTS[:4]:
        column, row = np.floor(projected(straight, point[None])[0]).astype(int)
        spot = np.zeros(SIZE, bool)
        spot[row, column] = True
        [[turned_row, turned_column]] = np.argwhere(np.rot90(spot, turns))
        pixel = projected(quarter_turn(straight, turns, SIZE), point[None])[0]
        assert np.abs(pixel - [turned_column + 0.5, turned_row + 0.5]).max() <= 0.5 + 1e-9


@pytest.mark.parametrize("extrinsics", ["world_to_camera", "camera_to_world"])
def test_a_unit_is_metres_of_one_unit_of_length(extrinsics):
    """A rig in millimetres: distances of cameras are a thousandth."""
    pose = pose_of(rig()["cam_01"])
    metres, millimetres = (
        extrinsics_of(pose, Convention(extrinsics=extrinsics, unit=unit)) for unit in (1.0, 0.001)
    )
    np.testing.assert_allclose(millimetres[:3, 3], metres[:3, 3] / 1000)
    np.testing.assert_array_equal(millimetres[:3, :3], metres[:3, :3])


@pytest.mark.parametrize("extrinsics", ["world_to_camera", "camera_to_world"])
def test_rotations_of_seven_digits_far_away(extrinsics):
    """Otherwise the centre is 9 mm from the centre of projection, and an image changes by up to 0.02."""
    rotation, center = rig()["cam_01"]["R"].round(7), np.array([1e5, -3e4, 1e4])
    pose, around = np.eye(4), center + POINTS
    pose[:3, :3] = rotation if extrinsics == "world_to_camera" else rotation.T
    pose[:3, 3] = -rotation @ center if extrinsics == "world_to_camera" else center
    found = extrinsics_of(pose, Convention(extrinsics=extrinsics))
    assert np.abs(found[:3, :3] @ found[:3, :3].T - np.eye(3)).max() < 1e-12
    assert np.abs(-found[:3, :3].T @ found[:3, 3] - center).max() < 1e-6
    local = around @ found[:3, :3].T + found[:3, 3]
    assert np.abs(local - POINTS @ rotation.T).max() < 1e-5


def test_every_format_can_be_said(tmp_path):
    assert get_args(nodes.Calibration.model_fields["format"].annotation) == ("auto", *FORMATS)
    write(tmp_path / "cameras.json", {"a": CAMERA})
    transforms(tmp_path, frame("b.png"))
    for place, said, name in (("", "auto", "b"), ("cameras.json", "ghgs", "a"), ("", "nerfstudio", "b")):
        assert list(read_cameras(tmp_path / place, said).cameras) == [name]
