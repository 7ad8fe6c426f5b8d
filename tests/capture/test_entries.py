"""Entries and names of calibrations in the spellings of programs and systems: lenses under every name,
types, unique meanings, and a warning about unread entries."""

import json
import os
import re

import numpy as np
import pytest
import yaml

from ghgs_capture.formats import read_cameras
from ghgs_lit.errors import InputError
from tests.helpers.calibrations import CAMERA, LENS, frame, one_camera, transforms, write

SPELLINGS = [
    *("D", "d", "dist", "Dist", "dists", "kc", "distortion", "distortions", "lens_distortion"),
    *("distCoeff", "distCoeffs", "dist_coeff", "dist-coeffs", "distCoef", "dist_coefs", "dist_params"),
    *("distortion_coefficients", "distortionCoefficients", "distortion_coefficient", "distortion_coeffs"),
    *("distortion_coef", "distortion_params", "distortion_parameters", "lensDistortionCoefficients"),
]
KB = {"camera_model": "pinhole", "D": [0.1, 0.2, 0.3, 0.4]}
SINGLE = {"k1": 0.1, "k2": 0.2, "k3": 0.3, "k4": 0.4}
OWN = {"intrinsics": CAMERA["K"], "extrinsics": np.eye(4).tolist()}

# Entries next to a camera's matrices, and the lens that they define: coefficients, and whether fisheye.
LENSES = [
    *(({spelling: LENS}, LENS, False) for spelling in SPELLINGS),
    *(({spelling: [LENS]}, LENS, False) for spelling in SPELLINGS),  # a row of a matrix, as from NumPy
    (dict(zip(("k1", "k2", "p1", "p2", "k3"), LENS, strict=True)), [*LENS, 0, 0, 0], False),
    (SINGLE | {"is_fisheye": True}, [0.1, 0.2, 0.3, 0.4], True),
    # As written by Kalibr and ROS, next to a pinhole.
    *(
        (KB | {"distortion_model": model}, KB["D"], True)
        for model in ("equidistant", "fisheye", "KANNALA_BRANDT", "OPENCV_FISHEYE")
    ),
    ({"distortion_model": "plumb_bob", "D": LENS}, LENS, False),
]


def test_lenses_that_are_read(tmp_path):
    for entries, distortion, fisheye in LENSES:
        camera = one_camera(tmp_path, **entries)
        np.testing.assert_array_equal(camera.distortion, distortion)
        assert camera.fisheye == fisheye


@pytest.mark.parametrize(
    ("entries", "line"),
    [
        ({"radial_distortion": [0.1, 0.2]}, r"a: expected lens distortion as D .*found \['radial_dist"),
        ({"omni": {"xi": 1.2}}, r"found \['omni'\]"),
        ({"camera_model": "omnidirectional"}, "a: camera_model: expected a camera model among .*'omnidirec"),
        ({"distortion_model": "mei"}, "a: distortion_model: expected a camera model among .*; found 'mei'"),
        ({"model": "double sphere"}, r"found \['model'\]"),
        ({"type": "fisheye", "D": [0.1, 0, 0, 0]}, r"found \['type'\]"),
        ({"latlong": True}, r"and no other camera model; found \['latlong'\]"),
        ({"equirectangular": 1}, r"found \['equirectangular'\]"),
        ({"k": [-0.35, 0.12]}, r"found \['k'\]"),
        ({"k": LENS}, r"found \['k'\]"),
        ({"D": LENS, "dist": [0.1, 0, 0, 0]}, "a: expected one distortion; found 'different ones: D and di"),
        ({"D": LENS, "k1": 0.3}, r"a: expected one distortion, \[-0\.35, .*found \"another: {'k1': 0\.3}"),
        ({"distortion_model": "equidistant", "fisheye": False, "D": [0.1, 0, 0, 0]}, "expected True beside"),
        ({"distortion_model": "equidistant", "camera_model": "opencv"}, "a: expected one model of the lens"),
        ({"distortion_model": "equidistant", "k1": 0.1, "p1": 0.1}, r"k1 k2 k3 k4; found \['p1'\]"),
        ({"R": np.eye(3).tolist(), "rot": [[0, 1, 0], [-1, 0, 0], [0, 0, 1]]}, "a: expected one rotation"),
    ],
)
def test_a_lens_that_is_not_read_is_refused(tmp_path, entries, line):
    with pytest.raises(InputError, match=line):
        one_camera(tmp_path, **entries)


@pytest.mark.filterwarnings("ignore:cameras. entries that are not read. k$")
def test_entries_that_say_the_same_twice(tmp_path):
    """A matrix with coefficients that are 0, one lens in two forms, and sizes that agree."""
    lens = {"D": LENS, "dist": [LENS], "k1": LENS[0], "k3": LENS[4], "k": [0, 0]}
    size = {"width": 640, "height": 480, "image_size": [640.0, 480.0]}
    camera = one_camera(tmp_path, camera_matrix=CAMERA["K"], fisheye=0, is_fisheye=False, **lens, **size)
    np.testing.assert_array_equal(camera.distortion, LENS)
    np.testing.assert_array_equal(camera.intrinsics, CAMERA["K"])
    assert camera.size == (480, 640)


def read_entries(tmp_path, kind, entries):
    """A camera of one of three formats with further entries."""
    if kind == "nerfstudio":
        return next(iter(read_cameras(transforms(tmp_path, frame("a.png", **entries))).cameras.values()))
    camera = OWN if kind == "ghgs" else CAMERA
    return read_cameras(write(tmp_path / "cameras.json", {"a": camera | entries})).cameras["a"]


KINDS = pytest.mark.parametrize("kind", ["ghgs", "opencv", "nerfstudio"])


@KINDS
def test_flags_that_are_read(tmp_path, kind):
    for value, found in ((True, 1), (1, 1), (1.0, 1), (False, 0), (0, 0), (None, 0)):
        camera = read_entries(tmp_path, kind, {"fisheye": value, "k1": 0.1, "k2": 0, "k3": None})
        assert camera.fisheye == bool(found)
        np.testing.assert_array_equal(camera.distortion[:2], [0.1, 0])


WRONG_TYPES = [
    ({"w": 0, "h": 480}, "width: expected a whole number above 0; found 0"),
    ({"w": 640.5, "h": 480}, "width: expected a whole number above 0; found 640.5"),
    ({"image_size": [640, 480.5]}, "height: expected a whole number above 0; found .*480.5"),
    ({"w": True, "h": 480}, "w: expected a finite number; found True"),
    ({"w": "wide", "h": 480}, "w: expected a finite number; found 'wide'"),
    ({"k1": True}, "k1: expected a finite number; found True"),
    ({"k1": [0.1]}, r"k1: expected a finite number; found \[0\.1\]"),
    ({"D": [0.1, True, 0, 0]}, r"D: expected numbers; found \[0\.1, True"),
    ({"D": "none"}, "D: expected an array"),
    ({"D": {"k1": 0.1}}, "D: expected an array"),
    # Text and 2 used to count as true, silently selecting another lens model.
    *(
        ({key: value}, f"{key}: expected true or false; found {re.escape(repr(value))}")
        for key in ("fisheye", "is_fisheye")
        for value in ("no", "0", 2, -1, 0.5, [1], {"on": True})
    ),
]


@KINDS
def test_values_have_types(tmp_path, kind):
    for entries, line in WRONG_TYPES:
        if kind == "nerfstudio" and "image_size" in entries:
            continue  # its frames have w and h
        with pytest.raises(InputError, match=line):
            read_entries(tmp_path, kind, entries)


def test_a_size_in_two_forms_that_differ(tmp_path):
    with pytest.raises(InputError, match="a: size: expected a width of 500"):
        one_camera(tmp_path, width=500, height=480, image_size=[640, 480])


@KINDS
def test_entries_that_are_not_read_are_named_in_one_note(tmp_path, kind):
    """Entries of all cameras and of the file; null counts as missing."""
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


def test_lenses_of_nerfstudio(tmp_path):
    lens = {"k1": 0.08, "k2": -0.02, "k3": 0.004, "k4": -0.001}
    for entries, distortion, fisheye in (
        (lens | {"is_fisheye": True}, list(lens.values()), True),
        (lens | {"camera_model": "OPENCV_FISHEYE"}, list(lens.values()), True),
        ({"camera_model": "SIMPLE_RADIAL", "k1": 0.05}, [0.05, 0, 0, 0, 0], False),
    ):
        camera = read_cameras(transforms(tmp_path, frame("a.png"), **entries)).cameras["a"]
        np.testing.assert_array_equal(camera.distortion, distortion)
        assert camera.fisheye == fisheye


ROW = "1 PINHOLE 640 480 500 500 320 240\n"
BELOW = {"cameras": {"a": CAMERA}, "fisheye": True}
TWICE = ", ".join(f'"{name}": {json.dumps(CAMERA)}' for name in "aba")


def colmap(tmp_path, *images):
    lines = [f"{i} 1 0 0 0 {i} 0 3 {camera} {name}\n\n" for i, (camera, name) in enumerate(images, 1)]
    for name, text in (("cameras", ROW), ("points3D", ""), ("images", "# names\n" + "".join(lines))):
        write(tmp_path / f"{name}.txt", text)
    return tmp_path


def piped(tmp_path):
    """A named pipe among COLMAP's files."""
    (colmap(tmp_path, (1, "a.jpg")) / "points3D.txt").unlink()
    os.mkfifo(tmp_path / "points3D.txt")
    return tmp_path


REFUSED = {
    "a lens of the file": (lambda p: write(p / "c.json", BELOW), r"as D .*found \['fisheye'\]"),
    "a lens beside cameras": (
        lambda p: write(p / "c.json", {"a": CAMERA, "fisheye": True}),
        r"as D .*found \['fisheye'\]",
    ),
    "two models": (
        lambda p: transforms(p, frame("a.png"), is_fisheye=True, camera_model="OPENCV"),
        "is_fisheye: expected False beside OPENCV",
    ),
    "k4": (lambda p: transforms(p, frame("a.png"), k4=0.1), r"distortion k1 k2 p1 p2 k3; found \['k4'\]"),
    "p1 of a fisheye": (
        lambda p: transforms(p, frame("a.png"), is_fisheye=True, p1=0.1),
        r"expected distortion k1 k2 k3 k4; found \['p1'\]",
    ),
    "f-theta": (lambda p: transforms(p, frame("a.png"), ftheta_p0=1.0), r"found \['ftheta_p0'\]"),
    "one name": (
        lambda p: transforms(p, frame("a.png"), frame("a.png", fl_x=501)),
        r"expected cameras of different names; found a\.png twice",
    ),
    "a key twice": (
        lambda p: write(p / "cameras.json", f"{{{TWICE}}}"),
        r"cameras\.json: expected JSON; found the key 'a' twice",
    ),
    "a pipe": (piped, r"points3D\.txt: expected a file of a COLMAP model; found 'no reg"),
    "an unknown camera of COLMAP": (
        lambda p: colmap(p, (1, "a.jpg"), (2, "b.jpg")),
        "expected a COLMAP model; found Rig with ID 2 does not exist",
    ),
    "half of a pair": (
        lambda p: write(p / "extri.yml", "a: 1"),
        r"intri\.yml: expected EasyMocap's file beside the other; found 'no such file'",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_files_that_are_refused(tmp_path, name):
    made, line = REFUSED[name]
    with pytest.raises(InputError, match=line):
        read_cameras(made(tmp_path))


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
    # For a moving camera, every photograph keeps its pose.
    frames[1]["fl_x"] += 1
    assert "images/cam0/0000.png" in read_cameras(transforms(tmp_path, *frames)).cameras


ONE = json.dumps({"a": CAMERA})
# Names and contents of files; names of the cameras that are read.
NAMES = [
    ("A.YML", ONE, ["a"]),
    ("b.Yaml", ONE, ["a"]),
    ("marked.json", f"\ufeff{ONE}", ["a"]),  # by editors of Windows
    (
        "numbers.yaml",
        "\n".join(f"{n}: {json.dumps(CAMERA)}" for n in ("0", "1", "08", "010")),
        ["0", "1", "08", "010"],
    ),
]


@pytest.mark.parametrize(("name", "text", "cameras"), NAMES)
def test_names_of_files_and_cameras(tmp_path, name, text, cameras):
    (tmp_path / name).write_text(text, encoding="utf-8")
    for path in (tmp_path, tmp_path / name):
        assert list(read_cameras(path).cameras) == cameras


def test_values_that_yaml_writes_once(tmp_path):
    """PyYAML writes a list that several cameras share as an anchor with references."""
    text = yaml.dump({name: CAMERA | {"D": LENS} for name in "ab"})
    assert "*id001" in text
    cameras = read_cameras(write(tmp_path / "a.yaml", text)).cameras
    np.testing.assert_array_equal(cameras["b"].intrinsics, CAMERA["K"])
    np.testing.assert_array_equal(cameras["b"].distortion, LENS)


def test_easymocaps_lens_counts_under_every_name(tmp_path):
    fields = {f"{key}_{name}": CAMERA[key] for name in ("1", "cam_1") for key in "KRT"}
    fields |= {"t_1": 0.5, "distCoeff_1": LENS, "dist_cam_1": [0.1, 0, 0, 0]}
    cameras = read_cameras(write(tmp_path / "all.yml", json.dumps(fields))).cameras
    np.testing.assert_array_equal(cameras["1"].distortion, LENS)
    np.testing.assert_array_equal(cameras["cam_1"].distortion, [0.1, 0, 0, 0])


def test_names_with_spaces_in_colmaps_text(tmp_path):
    cameras = read_cameras(colmap(tmp_path, (1, "front view 1.jpg"), (1, "front view 2.jpg"))).cameras
    assert {n: c.pose[0, 3] for n, c in cameras.items()} == {"front view 1": 1, "front view 2": 2}


def test_caliscope(tmp_path):
    """Tables below ``cameras``; an ignored camera has no matrices."""
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
