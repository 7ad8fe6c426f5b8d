"""Files of cameras and photographs as other programs and systems spell them."""

import json
import os
import re
import unicodedata

import numpy as np
import pytest
import yaml
from PIL import Image

from ghgs_lit import Capture
from ghgs_lit.errors import InputError
from ghgs_lit.prediction.capture.calibration import calibrate
from ghgs_lit.prediction.capture.camera_report import diagnose
from ghgs_lit.prediction.capture.folder import CaptureFolder
from ghgs_lit.prediction.capture.formats import read_cameras
from ghgs_lit.prediction.capture.masks import matte_of_file
from ghgs_lit.prediction.capture.photographs import Pixels
from tests.helpers.figures import Figure
from tests.helpers.rigs import POINTS, SIZE, opencv_pixels, rig

CAMERA = {"K": [[1000, 0, 320], [0, 1000, 240], [0, 0, 1]], "R": np.eye(3).tolist(), "T": [0, 0, 3]}
LENS = [-0.35, 0.12, 0.001, -0.0005, 0.01]


def write(path, content) -> object:
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def one_camera(tmp_path, **entries):
    return read_cameras(write(tmp_path / "cameras.json", {"a": CAMERA | entries})).cameras["a"]


@pytest.mark.parametrize(
    "spelling",
    [
        *("D", "d", "dist", "Dist", "dists", "kc", "distortion", "distortions", "lens_distortion"),
        *("distCoeff", "distCoeffs", "dist_coeff", "dist-coeffs", "distCoef", "dist_coefs", "dist_params"),
        *("distortion_coefficients", "distortionCoefficients", "distortion_coefficient", "distortion_coeffs"),
        *("distortion_coef", "distortion_params", "distortion_parameters", "lensDistortionCoefficients"),
    ],
)
def test_a_lens_counts_under_every_name(tmp_path, spelling):
    for value in (LENS, [LENS]):  # a list, or a row of a matrix as NumPy has it
        np.testing.assert_array_equal(one_camera(tmp_path, **{spelling: value}).distortion, LENS)


def test_a_lens_of_single_numbers_counts(tmp_path):
    numbers = dict(zip(("k1", "k2", "p1", "p2", "k3"), LENS, strict=True))
    np.testing.assert_array_equal(one_camera(tmp_path, **numbers).distortion, [*LENS, 0, 0, 0])
    fisheye = one_camera(tmp_path, k1=0.1, k2=0.2, k3=0.3, k4=0.4, is_fisheye=True)
    np.testing.assert_array_equal(fisheye.distortion, [0.1, 0.2, 0.3, 0.4])
    assert fisheye.fisheye


@pytest.mark.parametrize(
    ("entries", "line"),
    [
        (
            {"radial_distortion": [0.1, 0.2]},
            r"a: expected lens distortion as D .*found \['radial_distortion'\]",
        ),
        ({"omni": {"xi": 1.2}}, r"found \['omni'\]"),
        ({"camera_model": "omnidirectional"}, "a: camera_model: expected a camera model among .*'omnidirec"),
        ({"distortion_model": "mei"}, "a: distortion_model: expected a camera model among .*; found 'mei'"),
        ({"model": "double sphere"}, r"found \['model'\]"),
        ({"type": "fisheye", "D": [0.1, 0, 0, 0]}, r"found \['type'\]"),
        ({"latlong": True}, r"and no other camera model; found \['latlong'\]"),
        ({"equirectangular": 1}, r"found \['equirectangular'\]"),
        ({"k": [-0.35, 0.12]}, r"found \['k'\]"),
        ({"k": LENS}, r"found \['k'\]"),
        (
            {"D": LENS, "dist": [0.1, 0, 0, 0]},
            "a: expected one distortion; found 'different ones: D and dist'",
        ),
        ({"D": LENS, "k1": 0.3}, r"a: expected one distortion, \[-0\.35, .*found \"another: {'k1': 0\.3}"),
        ({"distortion_model": "equidistant", "fisheye": False, "D": [0.1, 0, 0, 0]}, "expected True beside"),
        ({"distortion_model": "equidistant", "camera_model": "opencv"}, "a: expected one model of the lens"),
        ({"distortion_model": "equidistant", "k1": 0.1, "p1": 0.1}, r"k1 k2 k3 k4; found \['p1'\]"),
    ],
)
def test_a_lens_that_is_not_read_is_refused(tmp_path, entries, line):
    with pytest.raises(InputError, match=line):
        one_camera(tmp_path, **entries)


@pytest.mark.parametrize("model", ["equidistant", "fisheye", "KANNALA_BRANDT", "OPENCV_FISHEYE"])
def test_a_fisheye_is_told_by_its_model(tmp_path, model):
    """Kalibr and ROS say it so, beside a pinhole."""
    lens = {"camera_model": "pinhole", "distortion_model": model, "D": [0.1, 0.2, 0.3, 0.4]}
    camera = one_camera(tmp_path, **lens)
    assert camera.fisheye
    np.testing.assert_array_equal(camera.distortion, lens["D"])
    assert not one_camera(tmp_path, distortion_model="plumb_bob", D=LENS).fisheye


def test_entries_that_say_the_same_twice(tmp_path):
    """A matrix beside coefficients that are 0, one lens in two forms, and sizes that agree."""
    lens = {"D": LENS, "dist": [LENS], "k1": LENS[0], "k3": LENS[4], "k": [0, 0]}
    size = {"width": 640, "height": 480, "image_size": [640.0, 480.0]}
    camera = one_camera(tmp_path, camera_matrix=CAMERA["K"], fisheye=0, is_fisheye=False, **lens, **size)
    np.testing.assert_array_equal(camera.distortion, LENS)
    np.testing.assert_array_equal(camera.intrinsics, CAMERA["K"])
    assert camera.size == (480, 640)


OWN = {"intrinsics": CAMERA["K"], "extrinsics": np.eye(4).tolist()}


def read_entries(tmp_path, kind, entries):
    """A camera of one of three formats with further entries."""
    if kind == "nerfstudio":
        return next(iter(read_cameras(transforms(tmp_path, frame("a.png", **entries))).cameras.values()))
    camera = OWN if kind == "ghgs" else CAMERA
    file = read_cameras(write(tmp_path / "cameras.json", {"a": camera | entries}))
    assert file.format == kind
    return file.cameras["a"]


KINDS = pytest.mark.parametrize("kind", ["ghgs", "opencv", "nerfstudio"])


@KINDS
@pytest.mark.parametrize("value", ["no", "false", "0", "yes", 2, -1, 0.5, [1], {"on": True}])
def test_flags_are_true_or_false(tmp_path, kind, value):
    """Text and 2 once counted as true: a lens of another model, without a word."""
    for key in ("fisheye", "is_fisheye"):
        with pytest.raises(
            InputError, match=rf"{key}: expected true or false; found {re.escape(repr(value))}"
        ):
            read_entries(tmp_path, kind, {key: value})


@KINDS
@pytest.mark.parametrize(("value", "found"), [(True, 1), (1, 1), (1.0, 1), (False, 0), (0, 0), (None, 0)])
def test_flags_that_are_read(tmp_path, kind, value, found):
    camera = read_entries(tmp_path, kind, {"fisheye": value, "k1": 0.1, "k2": 0, "k3": None})
    assert camera.fisheye == bool(found)
    np.testing.assert_array_equal(camera.distortion[:2], [0.1, 0])


@KINDS
@pytest.mark.parametrize(
    ("entries", "line"),
    [
        ({"w": 0, "h": 480}, "width: expected a whole number above 0; found 0"),
        ({"w": 640.5, "h": 480}, "width: expected a whole number above 0; found 640.5"),
        ({"w": True, "h": 480}, "w: expected a finite number; found True"),
        ({"w": "wide", "h": 480}, "w: expected a finite number; found 'wide'"),
        ({"k1": True}, "k1: expected a finite number; found True"),
        ({"k1": [0.1]}, r"k1: expected a finite number; found \[0\.1\]"),
        ({"D": [0.1, True, 0, 0]}, r"D: expected numbers; found \[0\.1, True"),
        ({"D": "none"}, "D: expected an array"),
        ({"D": {"k1": 0.1}}, "D: expected an array"),
    ],
)
def test_values_have_types(tmp_path, kind, entries, line):
    with pytest.raises(InputError, match=line):
        read_entries(tmp_path, kind, entries)


@KINDS
def test_entries_that_are_not_read_are_named_in_one_note(tmp_path, kind):
    """Of all cameras and of the file; null is nothing."""
    entries = {"colour": 3, "gain": None, "lens": "Nikkor 35 mm"}
    if kind == "nerfstudio":
        path = transforms(tmp_path, frame("a.png", **entries), frame("b.png", **entries), units="cm")
        named = "colour, lens, units"
    else:
        camera = (OWN if kind == "ghgs" else CAMERA) | entries
        content = {"cameras": {"a": camera, "b": camera, "c": {}}, "units": "cm"}
        path, named = write(tmp_path / "cameras.json", content), "c, colour, lens, units"
    with pytest.warns(UserWarning, match="not read") as shown:
        read_cameras(path)
    assert [str(warning.message) for warning in shown] == [f"cameras: entries that are not read: {named}"]


@pytest.mark.parametrize("place", ["file", "beside"])
def test_a_lens_beside_cameras_is_refused(tmp_path, place):
    """Said once for all cameras it was dropped."""
    content = (
        {"cameras": {"a": CAMERA}, "fisheye": True} if place == "file" else {"a": CAMERA, "fisheye": True}
    )
    with pytest.raises(InputError, match=r"expected lens distortion as D .*found \['fisheye'\]"):
        read_cameras(write(tmp_path / "cameras.json", content))


def frame(name, **entries):
    return {"file_path": name, "transform_matrix": np.eye(4).tolist()} | entries


def transforms(tmp_path, *frames, **entries):
    content = {"fl_x": 500, "cx": 320, "cy": 240, "w": 640, "h": 480, "frames": frames} | entries
    return write(tmp_path / "transforms.json", content)


def test_a_fisheye_lens_is_told_by_model_or_flag(tmp_path):
    lens = {"k1": 0.08, "k2": -0.02, "k3": 0.004, "k4": -0.001}
    for said in ({"is_fisheye": True}, {"camera_model": "OPENCV_FISHEYE"}):
        camera = read_cameras(transforms(tmp_path, frame("a.png"), **lens, **said)).cameras["a"]
        assert camera.fisheye
        np.testing.assert_array_equal(camera.distortion, list(lens.values()))
    for said, line in (
        (
            {"is_fisheye": True, "camera_model": "OPENCV"},
            "is_fisheye: expected False beside OPENCV",
        ),
        ({"k4": 0.1}, r"expected distortion k1 k2 p1 p2 k3; found \['k4'\]"),
        ({"is_fisheye": True, "p1": 0.1}, r"expected distortion k1 k2 k3 k4; found \['p1'\]"),
        ({"ftheta_p0": 1.0}, r"found \['ftheta_p0'\]"),
    ):
        with pytest.raises(InputError, match=line):
            read_cameras(transforms(tmp_path, frame("a.png"), **said))


def test_nerfstudios_simple_radial(tmp_path):
    file = read_cameras(transforms(tmp_path, frame("a.png"), camera_model="SIMPLE_RADIAL", k1=0.05))
    np.testing.assert_array_equal(file.cameras["a"].distortion, [0.05, 0, 0, 0, 0])


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
    """NeRF's and Blender's files have no size: the photographs have one, before and after a quarter turn."""
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


@pytest.fixture
def capture(tmp_path):
    """Photographs in ``images``, masks in ``masks``, the calibration beside them."""
    figure = Figure()
    path = figure.write(tmp_path / "images")
    path.rename(tmp_path / "cameras.json")
    (tmp_path / "masks").mkdir()
    for name in figure.names:
        (tmp_path / "images" / f"{name}_mask.png").rename(tmp_path / "masks" / f"{name}.png")
    return tmp_path


def read(capture, **options):
    options = {"masks": capture / "masks"} | options
    return Capture.read(capture / "images", capture / "cameras.json", **options)


def test_photographs_and_masks_may_be_links(capture):
    right = read(capture)
    for folder in ("images", "masks"):
        for path in (capture / folder).iterdir():
            stored = capture / "store" / f"{folder}-{path.name}"
            stored.parent.mkdir(exist_ok=True)
            path.rename(stored)
            path.symlink_to(stored)
    for one, other in zip(right.photographs, read(capture).photographs, strict=True):
        np.testing.assert_array_equal(one.matte, other.matte)


def rename(capture, folder, change):
    for path in (capture / folder).iterdir():
        os.rename(path, path.with_name(change(path.name)))


def renamed(capture, change):
    """Rename the cameras of the calibration."""
    content = json.loads((capture / "cameras.json").read_text())
    cameras = {change(name): camera for name, camera in content["cameras"].items()}
    write(capture / "cameras.json", {"cameras": cameras})


@pytest.mark.parametrize("change", [lambda n: n.replace(".png", ".PNG"), lambda n: n.replace(".", ".png.")])
def test_names_of_masks(capture, change):
    """``cam0.PNG`` of Windows, and COLMAP's ``cam0.png.png``."""
    rename(capture, "masks", change)
    assert len(read(capture).photographs) == 4


def test_a_capture_with_an_angle_of_view_alone(capture):
    """Masks and cameras of NeRF's file agree as with a size, also for the report."""
    own = json.loads((capture / "cameras.json").read_text())["cameras"]
    flip = np.diag([1.0, -1, -1, 1])
    frames = [
        frame(f"images\\{n}.png", transform_matrix=(np.linalg.inv(c["extrinsics"]) @ flip).tolist())
        for n, c in own.items()
    ]
    right = read(capture).photographs
    focal, width = right[0].intrinsics[0, 0], right[0].image.shape[1]
    content = {"camera_angle_x": 2 * np.arctan(width / 2 / focal), "frames": frames}
    write(capture / "cameras.json", content)
    for one, other in zip(right, read(capture).photographs, strict=True):
        np.testing.assert_allclose(one.intrinsics, other.intrinsics, atol=1e-9)
    folder = CaptureFolder(capture / "images", capture / "cameras.json", masks=capture / "masks")
    assert diagnose(folder).consistent


def test_a_turned_photograph_of_a_calibration_without_size(capture):
    """As shown, as OpenCV turns photographs: the report took it as stored, and accused the cameras."""
    own = json.loads((capture / "cameras.json").read_text())["cameras"]
    without = {n: {k: c[k] for k in ("intrinsics", "extrinsics")} for n, c in own.items()}
    write(capture / "cameras.json", {"cameras": without})
    for path in (capture / "images").iterdir():
        exif = Image.Exif()
        exif[0x0112] = 6
        Image.fromarray(np.rot90(np.asarray(Image.open(path)))).save(path, exif=exif)
    for photograph, mask in zip(read(capture).photographs, Figure().masks, strict=True):
        np.testing.assert_array_equal(photograph.mask, mask)
    assert diagnose(
        CaptureFolder(capture / "images", capture / "cameras.json", masks=capture / "masks")
    ).consistent


@pytest.mark.parametrize("change", [str.upper, str.title, lambda n: n.replace("cam", "Cam")])
def test_names_in_another_case(capture, change):
    """``CAM0.PNG`` of Windows is of the camera ``cam0``."""
    for folder in ("images", "masks"):
        rename(capture, folder, change)
    assert [photograph.name for photograph in read(capture).photographs] == Figure().names


def test_cameras_that_differ_by_case_alone(capture):
    """Exact names count, and no other is guessed."""
    renamed(capture, lambda name: {"cam2": "CAM1"}.get(name, name))
    rename(capture, "images", lambda n: n.replace("cam1", "Cam1").replace("cam2", "CAM1"))
    with pytest.raises(InputError, match=r"expected photographs named after cameras .*; found Cam1$"):
        read(capture)


def test_masks_that_a_windows_program_names(capture):
    """``masks\\cam0.PNG`` beside transforms.json is ``masks/cam0.png``."""
    own = json.loads((capture / "cameras.json").read_text())["cameras"]
    frames = [frame(f".\\images\\{n}.png", mask_path=f"masks\\{n}.PNG") for n in own]
    for entry, camera in zip(frames, own.values(), strict=True):
        entry["transform_matrix"] = np.linalg.inv(camera["extrinsics"]).tolist()
    size = next(iter(own.values()))
    shared = {"fl_x": size["intrinsics"][0][0], "w": size["width"], "h": size["height"], "frames": frames}
    write(capture / "cameras.json", shared)
    found = Capture.read(capture / "images", capture / "cameras.json", calibration={"axes": "opencv"})
    for photograph, mask in zip(found.photographs, Figure().masks, strict=True):
        np.testing.assert_array_equal(photograph.mask, mask)
    (capture / "masks" / "cam0.png").unlink()
    with pytest.raises(InputError, match=r"masks\\cam0\.PNG: expected an image; found no such file"):
        Capture.read(capture / "images", capture / "cameras.json")


def test_numbered_cameras_have_photographs_of_other_names(capture):
    renamed(capture, lambda name: name.removeprefix("cam"))
    for folder in ("images", "masks"):
        rename(capture, folder, lambda name: name.replace("cam", "view"))
    names = {f"view{n}": n for n in range(4)}
    assert len(read(capture, calibration={"names": names}).photographs) == 4


def test_letters_of_macos(capture):
    """An umlaut of two characters in names of files, of one in the calibration."""
    renamed(capture, lambda name: name.replace("cam", "K\u00e4the"))
    for folder, form in (("images", "NFD"), ("masks", "NFC")):
        rename(capture, folder, lambda n, form=form: unicodedata.normalize(form, n.replace("cam", "Käthe")))
    assert len(read(capture).photographs) == 4


def test_a_folder_of_macos(capture):
    """An instant, and a camera's folder, whose name has an umlaut of two characters."""
    name = unicodedata.normalize("NFD", "K\u00e4the")
    for folder in ("images", "masks"):
        (capture / folder).rename(capture / name)
        (capture / folder).mkdir()
        (capture / name).rename(capture / folder / name)
    folder = CaptureFolder(capture / "images", capture / "cameras.json", masks=capture / "masks")
    assert [len(folder.photographs(instant)) for instant in folder.instants] == [4]


def test_hidden_folders_are_no_instants(capture):
    for folder in ("images", "masks"):
        (capture / folder).rename(capture / "001")
        (capture / folder).mkdir()
        (capture / "001").rename(capture / folder / "001")
    hidden = capture / "images" / ".ipynb_checkpoints"
    hidden.mkdir()
    Image.new("RGB", (8, 8)).save(hidden / "cam0-checkpoint.png")
    folder = CaptureFolder(capture / "images", capture / "cameras.json", masks=capture / "masks")
    assert folder.instants == ["001"]


def matte(tmp_path, image):
    image.save(tmp_path / "mask.png")
    return matte_of_file(tmp_path / "mask.png", Pixels(np.zeros((40, 30, 3), np.uint8), None, 0))


def test_void_is_not_the_subject(tmp_path):
    """VOC: the person is 15, the rim around it 255; a soft matte has values between, and white is more."""
    values = np.zeros((40, 30), np.uint8)
    values[10:30, 8:22] = 255
    values[12:28, 10:20] = 15
    for mode in ("L", "P"):
        image = Image.fromarray(values)
        image = image if mode == "L" else image.convert("P")
        np.testing.assert_array_equal(matte(tmp_path, image), (values == 15) * 255)
    soft = np.where(values == 255, 15, np.where(values == 15, 255, 0)).astype(np.uint8)
    np.testing.assert_array_equal(matte(tmp_path, Image.fromarray(soft)), soft)


@pytest.mark.parametrize("mode", ["RGBA", "LA"])
def test_alpha_that_says_nothing_leaves_the_colour(tmp_path, mode):
    values = np.zeros((40, 30), np.uint8)
    values[10:30, 8:22] = 255
    np.testing.assert_array_equal(matte(tmp_path, Image.fromarray(values).convert(mode)), values)
