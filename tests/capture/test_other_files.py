"""Files of cameras as other programs and systems spell them."""

import json
import os

import numpy as np
import pytest
import yaml

from ghgs_capture.calibration import calibrate
from ghgs_capture.formats import read_cameras
from ghgs_lit.errors import InputError
from tests.helpers.calibrations import CAMERA, LENS, frame, one_camera, transforms, write
from tests.helpers.rigs import POINTS, SIZE, opencv_pixels, rig


def test_a_folder_of_each_camera_names_it(tmp_path):
    """Several instants list a camera several times."""
    frames = [
        frame(f"images/cam{c}/{i:04d}.png", mask_path=f"masks/cam{c}/{i:04d}.png", fl_x=500 + c)
        for c in range(3)
        for i in range(2)
    ]
    cameras = read_cameras(transforms(tmp_path, *frames[::2])).cameras
    assert list(cameras) == ["cam0", "cam1", "cam2"]
    assert cameras["cam1"].mask == tmp_path / "masks" / "cam1" / "0000.png"
    assert list(read_cameras(transforms(tmp_path, *frames)).cameras) == ["cam0", "cam1", "cam2"]
    # Of a camera that moves every photograph keeps its place.
    frames[1]["fl_x"] += 1
    assert "images/cam0/0000.png" in read_cameras(transforms(tmp_path, *frames)).cameras


def test_an_angle_of_view_alone_is_of_the_photograph(tmp_path):
    """NeRF's and Blender's files have no size: the photographs have one,
    before and after a quarter turn."""
    poses = rig()
    angle, frames = 2 * np.arctan(0.5), []
    for name, camera in poses.items():
        pose = np.eye(4)
        pose[:3, :3] = camera["R"].T @ np.diag([1, -1, -1])
        pose[:3, 3] = -camera["R"].T @ camera["T"]
        frames.append(frame(f"./train\\{name}", transform_matrix=pose.tolist()))
    shared = write(tmp_path / "transforms.json", {"camera_angle_x": angle, "frames": frames})
    file = read_cameras(shared)
    assert list(file.cameras) == list(poses)
    stored = file.cameras["cam_01"]
    for height, width in (SIZE, SIZE[::-1]):
        found = calibrate(stored, file.convention, (height, width))
        expected = [[width, 0, width / 2], [0, width, height / 2], [0, 0, 1]]
        np.testing.assert_allclose(found.intrinsics, expected, rtol=1e-12)
        np.testing.assert_allclose(found.extrinsics[:3, :3], poses["cam_01"]["R"], atol=1e-12)
    assert not stored.has_numbers_of(read_cameras(transforms(tmp_path, frame("cam_01"))).cameras["cam_01"])
    vertical = {"camera_angle_y": angle, "frames": frames}
    found = calibrate(read_cameras(write(shared, vertical)).cameras["cam_01"], file.convention, SIZE)
    assert found.intrinsics[0, 0] == pytest.approx(SIZE[0])
    for wrong in (0, 4, "wide"):
        with pytest.raises(InputError, match=r"camera_angle_x: expected (radians between 0 and pi|a finite)"):
            read_cameras(write(shared, {"camera_angle_x": wrong, "frames": frames}))
    with pytest.raises(InputError, match=r"frames\[0\]: expected fl_x or camera_angle_x; found"):
        read_cameras(write(shared, {"cx": 3, "frames": frames}))


def test_cameras_of_one_name_are_refused(tmp_path):
    path = transforms(tmp_path, frame("a.png"), frame("a.png", fl_x=501))
    with pytest.raises(InputError, match=r"expected cameras of different names; found a\.png twice"):
        read_cameras(path)


def test_a_camera_that_json_has_twice(tmp_path):
    """The second one won, and two of three cameras were read."""
    text = ", ".join(f'"{name}": {json.dumps(CAMERA)}' for name in "aba")
    with pytest.raises(InputError, match=r"cameras\.json: expected JSON; found the key 'a' twice"):
        read_cameras(write(tmp_path / "cameras.json", f"{{{text}}}"))


@pytest.mark.parametrize("name", ["A.YML", "b.Yaml"])
def test_endings_of_calibrations(tmp_path, name):
    write(tmp_path / name, json.dumps({"a": CAMERA}))
    assert list(read_cameras(tmp_path).cameras) == list(read_cameras(tmp_path / name).cameras) == ["a"]


def test_numbers_are_names_of_yaml(tmp_path):
    text = "\n".join(f"{n}: {json.dumps(CAMERA)}" for n in ("0", "1", "08", "010"))
    assert list(read_cameras(write(tmp_path / "a.yaml", text)).cameras) == ["0", "1", "08", "010"]


def test_values_that_yaml_writes_once(tmp_path):
    """PyYAML names a list that several cameras have, and refers to it."""
    text = yaml.dump({name: CAMERA | {"D": LENS} for name in "ab"})
    assert "*id001" in text
    cameras = read_cameras(write(tmp_path / "a.yaml", text)).cameras
    np.testing.assert_array_equal(cameras["b"].intrinsics, CAMERA["K"])
    np.testing.assert_array_equal(cameras["b"].distortion, LENS)


def test_a_pipe_among_files_of_colmap(tmp_path):
    (colmap(tmp_path, (1, "a.jpg")) / "points3D.txt").unlink()
    os.mkfifo(tmp_path / "points3D.txt")
    with pytest.raises(InputError, match=r"points3D\.txt: expected a file of a COLMAP model; found 'no reg"):
        read_cameras(tmp_path)


def test_easymocaps_lens_counts_under_every_name(tmp_path):
    fields = {f"{key}_{name}": CAMERA[key] for name in ("1", "cam_1") for key in "KRT"}
    fields |= {"t_1": 0.5, "distCoeff_1": LENS, "dist_cam_1": [0.1, 0, 0, 0]}
    cameras = read_cameras(write(tmp_path / "all.yml", json.dumps(fields))).cameras
    np.testing.assert_array_equal(cameras["1"].distortion, LENS)
    np.testing.assert_array_equal(cameras["cam_1"].distortion, [0.1, 0, 0, 0])


def colmap(tmp_path, *images):
    write(tmp_path / "cameras.txt", "1 PINHOLE 640 480 500 500 320 240\n")
    write(tmp_path / "points3D.txt", "")
    lines = [f"{i} 1 0 0 0 {i} 0 3 {camera} {name}\n\n" for i, (camera, name) in enumerate(images, 1)]
    write(tmp_path / "images.txt", "# names\n" + "".join(lines))
    return tmp_path


def test_names_with_spaces_in_colmaps_text(tmp_path):
    cameras = read_cameras(colmap(tmp_path, (1, "front view 1.jpg"), (1, "front view 2.jpg"))).cameras
    assert {name: camera.pose[0, 3] for name, camera in cameras.items()} == {
        "front view 1": 1,
        "front view 2": 2,
    }


def test_a_photograph_of_an_unknown_camera_of_colmap(tmp_path):
    with pytest.raises(InputError, match=r"expected a COLMAP model; found Rig with ID 2 does not exist"):
        read_cameras(colmap(tmp_path, (1, "a.jpg"), (2, "b.jpg")))


def test_caliscope(tmp_path):
    """Tables below ``cameras``; a camera that was left out has no matrices."""
    text = "".join(
        f"[cameras.{n}]\nport = {n}\nrotation_count = 0\nsize = [640, 480]\nmatrix = {CAMERA['K']}\n"
        f"distortions = {LENS}\ntranslation = {CAMERA['T']}\nrotation = [0.0, 0.1, 0.0]\n"
        for n in (1, 2)
    )
    path = write(tmp_path / "camera_array.toml", "[cameras.0]\nport = 0\nignore = true\n" + text)
    with pytest.warns(UserWarning, match="entries that are not read: 0"):
        cameras = read_cameras(path).cameras
    assert list(cameras) == ["1", "2"]
    assert cameras["1"].size == (480, 640)


def test_marks_of_windows_editors(tmp_path):
    (tmp_path / "a.json").write_text(json.dumps({"a": CAMERA}), encoding="utf-8-sig")
    assert list(read_cameras(tmp_path / "a.json").cameras) == ["a"]


QUALISYS = """<calibration><cameras><camera serial="{name}">
<fov_video left="0" top="0" right="{right}" bottom="{bottom}"/>
<transform x="{x}" y="{y}" z="{z}" {turn}/>
<intrinsic focalLengthU="{fx}" focalLengthV="{fy}" centerPointU="{cx}" centerPointV="{cy}"
 radialDistortion1="{k1}" radialDistortion2="{k2}" radialDistortion3="{k3}"
 tangentalDistortion1="{p1}" tangentalDistortion2="{p2}"/>
</camera></cameras></calibration>"""


def test_qualisys(tmp_path):
    """Millimetres, 1/64 pixels, y up and z backward, as its own program writes them."""
    for name, camera in rig().items():
        eye = -1000 * camera["R"].T @ camera["T"]
        turn = np.diag([1, -1, -1]) @ camera["R"]
        lens = dict(zip(("k1", "k2", "p1", "p2", "k3"), camera["D"], strict=True))
        k = 64 * camera["K"]
        text = QUALISYS.format(
            name=name, right=SIZE[1] - 1, bottom=SIZE[0] - 1,
            turn=" ".join(f'r{i + 1}{j + 1}="{turn[i, j]}"' for i in range(3) for j in range(3)),
            **dict(zip("xyz", eye, strict=True)), **lens,
            fx=k[0, 0], fy=k[1, 1], cx=k[0, 2], cy=k[1, 2],
        )  # fmt: skip
        file = read_cameras(write(tmp_path / "Calib.qca.txt", text))
        c = calibrate(file.cameras[name], file.convention, SIZE)
        pixels = opencv_pixels(POINTS, c.extrinsics[:3, :3], c.extrinsics[:3, 3], c.intrinsics, c.distortion)
        expected = opencv_pixels(POINTS, camera["R"], camera["T"], camera["K"], camera["D"]) + 0.5
        assert np.abs(pixels - expected).max() < 0.01
    with pytest.raises(
        InputError, match=r"Calib\.qca\.txt: expected cameras of Qualisys; found KeyError..focalLengthU"
    ):
        read_cameras(write(tmp_path / "Calib.qca.txt", text.replace("focalLengthU", "other")))


def test_video_of_1080_pixels_of_a_sensor_of_1088(tmp_path):
    camera = one_camera(tmp_path, width=1088, height=1920)
    file = read_cameras(tmp_path / "cameras.json")
    assert calibrate(camera, file.convention, (960, 540)).intrinsics[0, 0] == pytest.approx(500)
    with pytest.raises(InputError, match="expected a photograph of 1920x1088"):
        calibrate(camera, file.convention, (960, 500))
